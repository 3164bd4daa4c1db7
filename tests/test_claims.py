"""The numbers in the pages' sentences are those of the csv files."""

import re
from pathlib import Path

import pytest
from scripts import load_script

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"
PART = {"*.md": re.compile(r"^\*\*Answer\.\*\*.*", re.MULTILINE | re.DOTALL)}


def load(name: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(EXPERIMENTS)
    return load_script(EXPERIMENTS / f"{name}.py")


@pytest.fixture
def sentences(monkeypatch):
    return load("sentences", monkeypatch)


@pytest.fixture
def page(tmp_path):
    file = tmp_path / "page.md"
    file.write_text("It scores 3.577 ± 0.002 with three\nseeds, after 4,000 to 5,000 presses (\u22121.1 before).\n")
    return file


def claim(sentences, **numbers):
    found = {"score": "3.577 ± 0.002", "seeds": 3, "presses": "4,000 to 5,000", "before": -1.1} | numbers
    text = "It scores {score} with {seeds:word} seeds, after {presses} presses ({before:.1f} before)."
    return sentences.Claim("page.md", text, found)


def test_every_number_of_the_pages_is_that_of_its_csv_file_or_has_a_source(monkeypatch):
    """A failure means: run `python experiments/claims.py --write`, then read the changed sentences."""
    assert load("claims", monkeypatch).differences() == []


def test_a_sentence_that_agrees_has_no_line_and_its_page_stays(sentences, page):
    before = page.read_text()
    assert sentences.compare([claim(sentences)], page.parent, write=True) == []
    assert page.read_text() == before


@pytest.mark.parametrize(
    ("numbers", "line"),
    [
        ({"score": "3.578 ± 0.002"}, '"It scores 3.577 ± 0.002" says 3.577 ± 0.002, the csv files 3.578 ± 0.002'),
        ({"seeds": 10}, "says three, the csv files ten"),
        ({"presses": "4,000"}, "says 4,000 to 5,000, the csv files 4,000"),
        ({"before": float("inf")}, "says −1.1, the csv files never"),  # noqa: RUF001
        ({"before": 0.04}, "says −1.1, the csv files 0.0"),  # noqa: RUF001
    ],
)
def test_a_number_that_differs_is_told_and_written_on_request(sentences, page, numbers, line):
    wrong = claim(sentences, **numbers)
    before = page.read_text()
    (told,) = sentences.compare([wrong], page.parent)
    assert told.startswith("page.md: ") and told.endswith(line)
    assert page.read_text() == before
    assert sentences.compare([wrong], page.parent, write=True) == [told]
    assert sentences.compare([wrong], page.parent) == []
    assert len(page.read_text().split()) == len(before.split()) - (2 if "presses" in numbers else 0)


def test_a_sentence_that_is_gone_or_there_twice_or_no_longer_true_is_told(sentences, page):
    untrue = sentences.Claim("page.md", "It scores {score} with", {"score": "3.577 ± 0.002"}, holds=False)
    assert sentences.compare([untrue], page.parent) == [
        "page.md: by the csv files this is not true: It scores 3.577 ± 0.002 with"
    ]
    text = page.read_text()
    page.write_text(text.replace("scores", "returns"))
    assert "has this 0 times, not once: It scores {score}" in sentences.compare([claim(sentences)], page.parent)[0]
    page.write_text(text * 2)
    assert "has this 2 times, not once: It scores {score}" in sentences.compare([claim(sentences)], page.parent)[0]


@pytest.mark.parametrize(
    ("text", "numbers"),
    [
        ("**Answer.** It scores 3.5 of\n3.68 with five seeds.", ["3.5", "3.68", "five"]),
        ("**Answer.** It lost 94 % (−0.2), of five kinds, at commit 81b6c8d, with TD3.", ["94", "−0.2"]),  # noqa: RUF001
        ("Before 7.\n\n**Answer.** In `low.x=3`, [there](a/7.md):\n\n<!-- table -->\n| 7 |\n<!-- /table -->\n", []),
        ("**Answer.** A score of 5 after 1,000 layouts, with 12 seeds.", ["12"]),
        ("**Answer.** A score of 51 after 1,000 layouts.", ["51"]),
    ],
)
def test_a_number_in_a_covered_part_must_be_in_a_table_a_claim_or_a_list(sentences, tmp_path, text, numbers):
    (tmp_path / "page.md").write_text(text)
    scores = sentences.Claim("page.md", "A score of {score} after 1,000", {"score": 5})
    claims = [scores] if "of 5 " in text else []
    lines = sentences.uncovered(PART, claims, ["1,000 layouts"] if "layouts" in text else [], tmp_path)
    assert [line.split(": ")[-1] for line in lines] == [f"{number} is in no claim" for number in numbers]


def test_a_listed_text_that_no_covered_part_has_is_told(sentences, tmp_path):
    (tmp_path / "page.md").write_text("1,000 layouts.\n\n**Answer.** Yes.")
    assert sentences.uncovered(PART, [], ["1,000 layouts"], tmp_path) == [
        "'1,000 layouts' is in none of the pages' parts"
    ]


def test_a_study_whose_csv_files_lack_a_row_is_named_and_stops_no_other(monkeypatch):
    claims = load("claims", monkeypatch)

    def broken():
        return claims.rows("human/fit.csv", constant="none")

    monkeypatch.setattr(claims, "STUDIES", [broken, claims.human])
    found, (failure,) = claims.all_claims()
    assert failure == ("experiments/claims.py, broken: LookupError: human/fit.csv has no row with {'constant': 'none'}")
    assert len(found) == len(claims.human())
