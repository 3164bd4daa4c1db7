"""The report of all studies: renewed tables, one page that needs no other file, and failures that lose nothing else."""

import importlib.util
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parent.parent / "experiments" / "report.py"
STUDY = """
from pathlib import Path
from matplotlib.figure import Figure

def main(folders):
    figure = Figure()
    figure.subplots().plot([1, 2])
    figure.savefig(Path(__file__).parent / "line.png", dpi=20)
    print("From somewhere\\n\\n| a | b |\\n|---|---|\\n| 1 \\\\ 2 | 0.5 |\\n\\ndone")
"""
PAGE = """# Fine

See [the other](../sad/README.md).

before
<!-- table -->
| old |
<!-- /table -->
after

![line](line.png)
"""


@pytest.fixture(scope="module")
def module():
    if not SCRIPT.exists():
        pytest.skip("the studies are in the repository, not in the source distribution")
    spec = importlib.util.spec_from_file_location("report", SCRIPT)
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


@pytest.fixture
def experiments(tmp_path):
    for name, page, script in (
        ("fine", PAGE, STUDY),
        ("pageless", None, STUDY.replace("0.5", "0.7")),
        (
            "sad",
            "# Sad\n\n<!-- table -->\n| kept |\n<!-- /table -->\n",
            "def main(folders):\n    open('nowhere.csv')\n",
        ),
        ("told", "# Told\n", None),
    ):
        folder = tmp_path / "experiments" / name
        folder.mkdir(parents=True)
        if page:
            (folder / "README.md").write_text(page)
        if script:
            (folder / "study.py").write_text(script)
    return tmp_path / "experiments"


def test_a_failing_study_is_named_and_loses_neither_the_others_nor_its_page(module, experiments, tmp_path):
    (failure,) = module.report(experiments, tmp_path / "report")
    assert failure.startswith("sad: FileNotFoundError") and "nowhere.csv" in failure
    assert "| kept |" in (experiments / "sad/README.md").read_text()
    text = (tmp_path / "report/report.html").read_text()
    assert all(f'<section id="{name}">' in text for name in ("fine", "pageless", "sad", "told"))
    assert "<td>0.7</td>" in text and "Told</h1>" in text


def test_a_table_is_renewed_between_its_markers_and_nothing_else_of_the_page(module, experiments, tmp_path):
    module.report(experiments, tmp_path / "report")
    renewed = "<!-- table -->\n| a | b |\n|---|---|\n| 1 \\ 2 | 0.5 |\n<!-- /table -->"
    old = "<!-- table -->\n| old |\n<!-- /table -->"
    assert (experiments / "fine/README.md").read_text() == PAGE.replace(old, renewed)
    before = (experiments / "fine/README.md").stat().st_mtime_ns
    module.report(experiments, tmp_path / "report")
    assert (experiments / "fine/README.md").stat().st_mtime_ns == before


def test_the_front_page_gets_the_first_table_of_the_study_that_it_names(module, experiments, tmp_path):
    front = tmp_path / "README.md"
    kept = "<!-- table of sad -->\n| kept |\n<!-- /table -->\n"
    old = f"Good:\n\n<!-- table of fine -->\n| old |\n<!-- /table -->\n\n{kept}"
    front.write_text(old)
    module.report(experiments, tmp_path / "report")
    assert front.read_text() == old.replace("| old |", "| a | b |\n|---|---|\n| 1 \\ 2 | 0.5 |")


def test_every_figure_is_there_as_png_beside_its_page_and_as_svg_in_the_report(module, experiments, tmp_path):
    module.report(experiments, tmp_path / "report")
    assert (experiments / "fine/line.png").read_bytes().startswith(b"\x89PNG")
    assert "<svg" in (tmp_path / "report/fine/line.svg").read_text()
    assert not list(experiments.rglob("*.svg"))


def test_the_report_needs_no_other_file(module, experiments, tmp_path):
    module.report(experiments, tmp_path / "report")
    text = (tmp_path / "report/report.html").read_text()
    assert text.count("<img") == text.count('src="data:image/png;base64,') == 2
    assert 'href="#sad"' in text and "README.md" not in text


def test_a_missing_image_is_named(module, experiments, tmp_path):
    (experiments / "told/README.md").write_text("# Told\n\n![x](gone.png)\n")
    assert "told: no image gone.png" in module.report(experiments, tmp_path / "report")


def test_the_exit_code_says_whether_all_studies_worked(module, experiments, monkeypatch, capsys):
    monkeypatch.setattr(module, "HERE", experiments)
    assert module.main() == 1
    assert capsys.readouterr().err.startswith("sad: FileNotFoundError")
    (experiments / "sad/study.py").write_text(STUDY)
    assert module.main() == 0
    assert capsys.readouterr().err == "" and "study_fine" not in sys.modules
