"""Words for the user: one line each, on streams that may be gone."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from typing import TextIO


def one_line(text: object) -> str:
    """Return a text or an error's message as one line, with every run of whitespace as one space."""
    return " ".join(str(text).split())


def first_line(text: object) -> str:
    """Return the first line of a text or of an error's message."""
    return one_line(str(text).strip().partition("\n")[0])


def reopen_standard_streams() -> None:
    """Open the null device in the place of standard streams that are closed, as in `2>&-` and in some daemons.

    Otherwise the next file that is opened gets the number of the closed stream, and libraries write their messages into
    it. Call it before anything else is opened.
    """
    for number, (name, mode) in enumerate({"stdin": "r", "stdout": "w", "stderr": "w"}.items()):
        try:
            os.fstat(number)
        except OSError:
            opened = os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is this one
            os.set_inheritable(opened, True)
        if getattr(sys, name) is None:
            stream = open(number, mode, encoding="utf-8", closefd=False)  # noqa: SIM115  # stays open
            setattr(sys, name, stream)


class LenientStream:
    """A text stream on which writing never fails: a terminal that was closed or a full disk costs the text alone.

    Args:
        stream: where the text goes; None, as `sys.stderr` is if it was closed: nowhere.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write the text if possible."""
        if self._stream is not None:
            with suppress(OSError, ValueError):
                self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush the stream if possible."""
        if self._stream is not None:
            with suppress(OSError, ValueError):
                self._stream.flush()

    def isatty(self) -> bool:
        """Return whether the stream is a terminal."""
        if self._stream is not None:
            with suppress(OSError, ValueError):
                return self._stream.isatty()
        return False


def say(text: str) -> None:
    """Print to stdout, if it is still there."""
    _print(text, sys.stdout)


def warn(message: str) -> None:
    """Write one line to stderr, if it is still there; the logging module may be switched off."""
    _print(message, sys.stderr)


def _print(text: str, stream: TextIO | None) -> None:
    if stream is None:  # which `print` takes for stdout
        return
    try:
        print(text, file=stream, flush=True)
    except (OSError, ValueError):
        # Otherwise the interpreter fails once more when it flushes the stream at its end.
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def duration(seconds: float) -> str:
    """Return a time in words, as precise as its length calls for."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s"


def invalid_action(row: int, values: Mapping[str, tuple[object, str]]) -> ValueError:
    """Return the error for an invalid action.

    Args:
        row: number of the environment.
        values: for each leaf of the action its value and what is allowed.
    """
    listed = ", ".join(f"{name}={value} ({allowed})" for name, (value, allowed) in values.items())
    return ValueError(f"step: environment {row} got {listed}")
