"""The tutorials in docs/tutorials run: their commands and their Python, in the order of the page.

A block `shell` holds commands of `hpamdp`, a block `python` code, which shares its names with the blocks before it.
What Python prints has to be what a block `text` right after it says. The cells of a notebook share their names, too.
"""

import ast
import io
import json
import os
import re
import shlex
import shutil
import sys
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from conftest import forked

from hpamdp import cli
from hpamdp.data.human.released_file import PATH_VARIABLE

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted((ROOT / "docs/tutorials").glob("*.md"))
NOTEBOOK = ROOT / "docs/tutorials/python.ipynb"
MOST_LINES = 8
BLOCK = re.compile(
    r"^```(?P<kind>python|shell)\n(?P<code>.*?)^```\n(?:\n```text\n(?P<printed>.*?)^```\n)?", re.M | re.S
)


def follow(page: Path, folder: Path) -> None:
    """Do what a page says, in a folder."""
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    names: dict = {}
    for block in BLOCK.finditer(page.read_text()):
        if block["kind"] == "shell":
            for line in block["code"].replace("\\\n", " ").splitlines():
                assert forked(run, shlex.split(line)) == 0, line
            continue
        with redirect_stdout(io.StringIO()) as printed:
            exec(compile(block["code"], str(page), "exec"), names)
        assert block["printed"] in (None, printed.getvalue()), printed.getvalue()


def cells(notebook: Path) -> list[str]:
    """Return the code of a notebook's cells."""
    found = json.loads(notebook.read_text())["cells"]
    return ["".join(cell["source"]) for cell in found if cell["cell_type"] == "code"]


def run_cells(folder: Path) -> None:
    """Run the notebook in a folder, and check what it shows."""
    os.chdir(folder)
    names: dict = {}
    for code in cells(NOTEBOOK):
        exec(compile(code, NOTEBOOK.name, "exec"), names)
    assert names["scores"]["score"] > 3.5
    assert names["driver"].evaluate(episodes=100)["success"] > 0.5
    assert names["returns"].mean() > 0.4
    assert sorted(path.name for path in folder.iterdir()) == ["agent.safetensors", "runs"]


def run(words: list[str]) -> None:
    """Run a command line."""
    assert words[0] == "hpamdp"
    sys.argv = words
    cli.main()


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_tutorial_does_what_it_says(page, tmp_path):
    if PATH_VARIABLE in page.read_text() and not os.environ.get(PATH_VARIABLE):
        pytest.skip(f"{PATH_VARIABLE} is not set")
    folder = tmp_path / "extending"
    shutil.copytree(ROOT / "examples/extending", folder, ignore=shutil.ignore_patterns("__pycache__", "outputs"))
    assert forked(follow, page, folder) == 0


@pytest.mark.slow
def test_the_notebook_runs_and_its_agents_learn(tmp_path):
    assert forked(run_cells, tmp_path) == 0


def test_no_cell_of_the_notebook_is_long_and_none_has_outputs():
    for code in cells(NOTEBOOK):
        classes = [node for node in ast.parse(code).body if isinstance(node, ast.ClassDef)]
        inside = sum(node.end_lineno - node.lineno + 1 for node in classes)
        assert len([line for line in code.splitlines() if line]) - inside <= MOST_LINES, code
    assert not [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell.get("outputs")]


def test_the_yaml_files_that_tutorials_show_are_those_of_the_examples():
    files = [file.read_text() for file in (ROOT / "examples/extending/conf").rglob("*.yaml")]
    for page in PAGES:
        for shown in re.findall(r"^```yaml\n(.*?)^```", page.read_text(), re.M | re.S):
            assert shown in files, page.name
