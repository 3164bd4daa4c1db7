"""Words for the user: one line each."""

from __future__ import annotations

import sys


def one_line(text: object) -> str:
    """Return a text or an error's message as one line, with every run of whitespace as one space."""
    return " ".join(str(text).split())


def first_line(text: object) -> str:
    """Return the first line of a text or of an error's message."""
    return one_line(str(text).strip().partition("\n")[0])


def warn(message: str) -> None:
    """Write one line to stderr; the logging module may be switched off."""
    print(message, file=sys.stderr)


def duration(seconds: float) -> str:
    """Return a time in words, as precise as its length calls for."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s"
