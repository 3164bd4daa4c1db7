"""Read files with a JSON value in each line, some of them damaged, for example cut short by a full disk."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

from hpamdp.messages import first_line, one_line

MAX_LINE_BYTES = 1 << 20
_NUM_SHOWN = 3


class LineError(ValueError):
    """Raised for a line without a value; the message is one line."""


def read_json(data: bytes) -> Any:
    """Return the value of a line, or of a small file.

    Raises:
        LineError: the data hold no JSON value, are too long, or give a key of an object twice.
    """
    if len(data) > MAX_LINE_BYTES:
        raise LineError(f"longer than {MAX_LINE_BYTES} bytes")
    try:
        return json.loads(data.decode("utf-8-sig"), object_pairs_hook=_once, parse_constant=_refused)
    except LineError:
        raise
    except (ValueError, RecursionError) as error:
        raise LineError(f"no JSON: {first_line(error)}") from error


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return an object. Of a key that is given twice, readers would take the last value."""
    names = dict(pairs)
    if len(names) < len(pairs):
        twice = next(name for name, number in Counter(name for name, _ in pairs).items() if number > 1)
        raise LineError(f"{one_line(twice)[:40]} is given twice")
    return names


def _refused(constant: str) -> None:
    raise ValueError(f"{constant} is no number of JSON")


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
