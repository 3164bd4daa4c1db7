"""Read files with a JSON value in each line, some of them damaged, for example cut short by a full disk."""

from __future__ import annotations

import codecs
import json
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic_core import from_json  # refuses deep nesting, at which `json` meets Python's recursion limit

from hpamdp.messages import one_line

MAX_LINE_BYTES = 1 << 20
_NUM_SHOWN = 3


class LineError(ValueError):
    """Raised for a line without a value; the message is one line."""


def read_json(line: bytes) -> Any:
    """Return the value of a line.

    Raises:
        LineError: the line holds no JSON value, or is too long.
    """
    if len(line) > MAX_LINE_BYTES:
        raise LineError(f"longer than {MAX_LINE_BYTES} bytes")
    if line.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise LineError("UTF-16, but must be UTF-8")
    plain = line.removeprefix(codecs.BOM_UTF8)
    try:
        value = from_json(plain, allow_inf_nan=False)
    except ValueError as error:
        raise LineError("no JSON") from error
    twice = key_given_twice(plain)
    if twice is not None:
        raise LineError(f"{one_line(twice)[:40]} is given twice")
    return value


def key_given_twice(data: bytes) -> str | None:
    """Return a key that some object of a JSON text has twice, or None. Readers would take its last value.

    Args:
        data: a text that `from_json` has read, so that it is not nested deeply.
    """
    found: list[str] = []

    def check(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = dict(pairs)
        if len(names) < len(pairs):
            counted = Counter(name for name, _ in pairs)
            found.append(next(name for name, number in counted.items() if number > 1))
        return names

    json.loads(data, object_pairs_hook=check)
    return found[0] if found else None


def lines_of(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the non-blank lines with their numbers, starting from 1."""
    for number, line in enumerate(data.split(b"\n"), 1):
        if line.strip():
            yield number, line


def left_out(num_lines: int, problems: Mapping[int, str]) -> str:
    """Return a message of one line: how many lines were left out, and the problems of the first ones.

    Args:
        num_lines: number of all lines.
        problems: the problem of each line that was left out, by the line's number.
    """
    named = [f"line {number} ({problem})" for number, problem in sorted(problems.items())[:_NUM_SHOWN]]
    more = ", ..." if len(problems) > _NUM_SHOWN else ""
    return f"{len(problems)} of {num_lines} lines left out: {', '.join(named)}{more}"
