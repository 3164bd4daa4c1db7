"""Sentences of pages whose numbers follow from csv files: `Claim`, the comparison, and the numbers that no claim has.

claims.py has the sentences.
"""

from __future__ import annotations

import math
import re
import string
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

WORDS = [
    *("zero", "one", "two", "three", "four", "five", "six", "seven"),
    *("eight", "nine", "ten", "eleven", "twelve", "thirteen", "fourteen", "fifteen"),
]
# A number as a page writes it, and several: "4,000 to 5,000", "3.577 ± 0.002", "220 and 226", "400, never, 600".
DIGITS = r"[-\u2212+]?\d+(?:,\d{3})*(?:\.\d+)?"
WORD = rf"\b(?i:{'|'.join(WORDS)})\b"
NUMBERS = rf"(?:{DIGITS}|{WORD}|never)(?:(?:\s+to\s+|\s+and\s+|,\s+|\s+±\s+)(?:{DIGITS}|{WORD}|never))*"
# What must be in a claim: a number in digits, or a number of seeds in words.
RESULT = re.compile(rf"(?<![\w.]){DIGITS}(?!\w|\.\d)|{WORD}(?=\s+seeds?\b)")
# What is no sentence: renewed tables, code, and the addresses of links.
TABLE = r"<!-- (?:table|rows of|csv|runs) .*?<!-- /table -->"
NO_SENTENCE = re.compile(rf"{TABLE}|^```.*?^```|`[^`]*`|\]\([^)]*\)", re.MULTILINE | re.DOTALL)


class Claim:
    """A sentence of a page, with numbers that follow from csv files."""

    def __init__(self, page: str, sentence: str, numbers: Mapping[str, Any], holds: bool = True) -> None:
        """Hold the sentence.

        Args:
            page: path of the page in the repository.
            sentence: a sentence, or its part with the numbers, that occurs once in the page. Its places are those of
                `str.format`. The format `word` writes 3 as three, and `Word` as Three.
            numbers: numbers or texts by the names of the places. It may have others, too.
            holds: whether the rest of the sentence is true, such as "every learner scores above people".
        """
        self.page, self.sentence, self.holds = page, sentence, holds
        self.numbers: list[str] = []
        pattern = ""
        form = string.Formatter()
        for words, place, style, _ in form.parse(sentence):
            pattern += spaced(words)
            if place is not None:
                pattern += f"({NUMBERS})"
                self.numbers.append(in_prose(form.get_field(place, (), numbers)[0], style or ""))
        self.pattern = re.compile(rf"(?<![\w.]){pattern}")


def spaced(words: str) -> str:
    """Return a pattern of these words in which a space may also be the end of a line."""
    return r"\s+".join(map(re.escape, re.split(r"\s+", words)))


def in_prose(value: Any, style: str) -> str:
    """Return a number as a page writes it, with a minus sign instead of a hyphen; infinity is never."""
    if value == math.inf:
        return "never"
    if style in ("word", "Word"):
        word = WORDS[value] if value < len(WORDS) else f"{value:,}"
        return word.capitalize() if style == "Word" else word
    return format(value, style).replace("-", "\u2212")


def compare(claims: Iterable[Claim], root: Path, write: bool = False) -> list[str]:
    """Return a line for each difference between the pages and the csv files.

    Args:
        claims: the claims.
        root: the folder of the repository.
        write: whether to put the numbers of the csv files into the pages.
    """
    lines = []
    for claim in claims:
        page = root / claim.page
        text = page.read_text(encoding="utf-8")
        found = list(claim.pattern.finditer(text))
        if len(found) != 1:
            lines.append(f"{claim.page}: has this {len(found)} times, not once: {claim.sentence}")
            continue
        if not claim.holds:
            lines.append(f"{claim.page}: by the csv files this is not true: {' '.join(found[0][0].split())}")
        for place in range(len(claim.numbers), 0, -1):  # from the last one, because a new number moves what follows
            said, number = " ".join(found[0][place].split()), claim.numbers[place - 1]
            if said != number:
                start, end = found[0].span(place)
                until_there = " ".join(text[:end].split()[-7:])
                lines.append(f'{claim.page}: "{until_there}" says {said}, the csv files {number}')
                text = text[:start] + number + text[end:]
        if write:
            page.write_text(text, encoding="utf-8")
    return lines


def uncovered(
    parts: Mapping[str, re.Pattern[str]], claims: Sequence[Claim], others: Iterable[str], root: Path
) -> list[str]:
    """Return a line for each number that is in no renewed table, no claim and no text of `others`.

    A text of `others` that is in none of the parts has a line, too.

    Args:
        parts: patterns of the parts of pages to search, by the pages' path in the repository, which may have a `*`.
        claims: the claims.
        others: parts of sentences whose numbers do not follow from csv files.
        root: the folder of the repository.
    """
    lines, missing = [], set(others)
    for pages, part in parts.items():
        for page in sorted(root.glob(pages)):
            name = page.relative_to(root).as_posix()
            for text in part.findall(page.read_text(encoding="utf-8")):
                covered = [found.span() for found in NO_SENTENCE.finditer(text)]
                for claim in claims:
                    if claim.page == name:
                        covered += [place for found in claim.pattern.finditer(text) for place in found.regs[1:]]
                for other in others:
                    places = [found.span() for found in re.finditer(rf"(?<!\w){spaced(other)}(?!\w)", text)]
                    covered += places
                    missing -= {other} if places else set()
                for found in RESULT.finditer(text):
                    if not any(start <= found.start() < end for start, end in covered):
                        until_there = " ".join(text[: found.end()].split()[-7:])
                        lines.append(f'{name}: "{until_there}": {found[0]} is in no claim')
    return [*lines, *(f"{other!r} is in none of the pages' parts" for other in sorted(missing))]
