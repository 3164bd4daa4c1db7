"""Pages with the tables of all studies, and failures that stop nothing else."""

import sys
from pathlib import Path

import pytest
from scripts import load_script

SCRIPT = Path(__file__).resolve().parent.parent / "experiments" / "report.py"
STUDY = """
from pathlib import Path
from matplotlib.figure import Figure

def main(folders):
    figure = Figure()
    figure.subplots().plot([1, 2])
    figure.savefig(Path(__file__).parent / "line.png", dpi=20)
    print("From somewhere\\n")
    print("| a | b |\\n|---|---|\\n| 1 \\\\ 2 | 0.5 |\\n")
    print("| c |\\n|---|\\n| 3 |\\n\\ndone")
"""
PAGE = """# Fine

before
<!-- table -->
| old |
<!-- /table -->
after

![line](line.png)
"""


HOOKS = """
SiteError = ValueError

def with_tables(text):
    if "wrong" in text:
        raise SiteError("no row")
    return text.replace("old", "new")
"""
FIRST_TABLE = "| a | b |\n|---|---|\n| 1 \\ 2 | 0.5 |"
SECOND_TABLE = "| c |\n|---|\n| 3 |"


@pytest.fixture(scope="module")
def module():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SCRIPT.parent)
        yield load_script(SCRIPT)


@pytest.fixture
def experiments(tmp_path):
    """Make a folder of studies: one that works, one that fails, and a page without a study."""
    pages = {"fine": PAGE, "sad": "# Sad\n\n<!-- table -->\n| kept |\n<!-- /table -->\n", "no_study": "# No study\n"}
    scripts = {"fine": STUDY, "sad": "def main(folders):\n    open('nowhere.csv')\n"}
    root = tmp_path / "experiments"
    for name, page in pages.items():
        (root / name).mkdir(parents=True)
        (root / name / "README.md").write_text(page)
    for name, script in scripts.items():
        (root / name / "study.py").write_text(script)
    return root


def test_a_failing_study_is_named_and_stops_neither_the_others_nor_its_own_page(module, experiments):
    (failure,) = module.report(experiments)
    assert failure.startswith("sad: FileNotFoundError") and "nowhere.csv" in failure
    assert "| kept |" in (experiments / "sad/README.md").read_text()
    assert (experiments / "fine/line.png").read_bytes().startswith(b"\x89PNG")


def test_all_tables_are_renewed_between_the_markers_and_nothing_else_of_the_page(module, experiments):
    module.report(experiments)
    renewed = f"<!-- table -->\n{FIRST_TABLE}\n\n{SECOND_TABLE}\n<!-- /table -->"
    old = "<!-- table -->\n| old |\n<!-- /table -->"
    assert (experiments / "fine/README.md").read_text() == PAGE.replace(old, renewed)


@pytest.mark.parametrize("name", ["README.md", "docs/results.md"])
def test_the_front_page_and_the_documentation_get_the_tables_that_they_number(module, experiments, tmp_path, name):
    page = tmp_path / name
    page.parent.mkdir(exist_ok=True)
    first = "Good:\n\n<!-- table 1 of fine -->\n| old |\n<!-- /table -->\n\n"
    second = "<!-- table 2 of fine -->\n| older |\n<!-- /table -->\n\n"
    of_failed_study = "<!-- table 1 of sad -->\n| kept |\n<!-- /table -->\n"
    page.write_text(first + second + of_failed_study)
    module.report(experiments)
    renewed = first.replace("| old |", FIRST_TABLE) + second.replace("| older |", SECOND_TABLE)
    assert page.read_text() == renewed + of_failed_study


@pytest.mark.parametrize("number", [0, 3])
def test_a_table_that_a_study_does_not_have_is_named_and_what_is_there_stays(module, experiments, tmp_path, number):
    front = tmp_path / "README.md"
    text = f"<!-- table {number} of fine -->\n| kept |\n<!-- /table -->\n"
    front.write_text(text)
    assert f"README.md: no table {number} of fine" in module.report(experiments)
    assert front.read_text() == text


def test_the_exit_code_says_whether_all_studies_worked(module, experiments, monkeypatch, capsys):
    monkeypatch.setattr(module, "HERE", experiments)
    assert module.main() == 1
    assert capsys.readouterr().err.startswith("sad: FileNotFoundError")
    (experiments / "sad/study.py").write_text(STUDY)
    assert module.main() == 0
    assert capsys.readouterr().err == "" and "fine_study" not in sys.modules


def test_tables_of_directives_are_renewed_in_all_pages_and_wrong_ones_are_told(module, tmp_path):
    docs = tmp_path / "docs"
    (docs / "domains").mkdir(parents=True)
    (docs / "hooks.py").write_text(HOOKS)
    (docs / "domains/a.md").write_text("old")
    (docs / "b.md").write_text("wrong")
    assert module.renew_filled(docs) == ["b.md: no row"]
    assert (docs / "domains/a.md").read_text() == "new"
    assert module.renew_filled(tmp_path) == []
