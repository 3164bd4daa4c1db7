"""The numbers in the pages' sentences are those of the csv files."""

import re
from pathlib import Path

import pytest
from scripts import load_script

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def module():
    return load_script(ROOT / "experiments/fill_numbers.py")


def test_every_number_of_the_pages_is_that_of_its_csv_file(module):
    """A failure means: run `python experiments/fill_numbers.py --write`, then read the changed sentences."""
    assert module.differences() == []


def test_no_line_begins_with_a_number_because_markdown_would_end_the_paragraph_there(module):
    begins = re.compile(r"^\s*(?:[-*>] +|\d+\. +)?<!--n ", re.MULTILINE)
    pages = [page for pattern in module.PAGES for page in ROOT.glob(pattern)]
    assert not [page for page in pages if begins.search(page.read_text(encoding="utf-8"))]


def test_a_number_that_differs_is_named_and_written_on_request(module, tmp_path, monkeypatch):
    (tmp_path / "runs.json").write_text('{"low": "hppo", "score": [2.5, -3.5], "seed": [0, 1]}')
    monkeypatch.setattr(module, "ROOT", tmp_path)
    page = tmp_path / "page.md"
    numbers = "It scores <!--n min(hppo.score):.2f-->{}<!--/n--> with <!--n count(hppo.seed):word-->{}<!--/n--> seeds."
    data = "\n\n<!--data hppo: runs.json low=hppo-->\n"
    page.write_text(numbers.format("1.00", "two") + data)
    line = "page.md: says 1.00, min(hppo.score) is \u22123.50"
    assert module.differences(tmp_path, write=True) == [line]
    assert page.read_text() == numbers.format("\u22123.50", "two") + data
    page.write_text("<!--data hsac: runs.json low=hsac-->")
    assert module.differences(tmp_path) == ["page.md: LookupError: no row has runs.json low=hsac"]
