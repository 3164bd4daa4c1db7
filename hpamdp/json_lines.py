"""Read files with a JSON value in each line, some of them damaged, for example cut short by a full disk."""

from __future__ import annotations

import codecs
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic_core import from_json  # refuses deep nesting, at which `json` meets Python's recursion limit

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
    try:
        return from_json(line.removeprefix(codecs.BOM_UTF8), allow_inf_nan=False)
    except ValueError as error:
        raise LineError("no JSON") from error


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
