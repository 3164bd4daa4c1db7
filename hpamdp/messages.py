"""Write messages of one line to the user, on streams that may be closed, and end with an exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import cache
from io import TextIOWrapper
from typing import Any, TextIO, cast

# Exit codes of the command line, beside 0.
FAILED = 1
MISTAKE = 2  # of the user: a refused setting, file or environment
DIVERGED = 3
INTERRUPTED = 130  # 128 + SIGINT, as shells report it
_LONGEST_CODE = 80  # letters of a value in a message


class ProblemError(ValueError):
    """A problem breaks its own contract, such as with an observation outside its space; the message is one line."""


def one_line(text: object) -> str:
    """Return a text or an error's message as one line, with a space in place of every line break.

    Other control characters, such as those of escape sequences, become question marks.
    """
    line = " ".join(line for line in map(str.strip, str(text).expandtabs().splitlines()) if line)
    return "".join(character if character.isprintable() else "?" for character in line)


def as_code(value: object) -> str:
    """Return a value as Python code shows it, in one line; a long one is cut short."""
    text = one_line(repr(value))
    return text if len(text) <= _LONGEST_CODE else f"{text[:_LONGEST_CODE]}..."


def first_line(text: object) -> str:
    """Return the first line of a text or of an error's message."""
    return one_line(str(text).strip().partition("\n")[0])


class LenientStream:
    """A text stream on which writing never fails. If the terminal was closed or the disk is full, only text is lost.

    Args:
        stream: the stream to write to. A letter that it cannot encode is written as its number.

    Attributes:
        error: the last error of a write; None if all text was written.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.error: OSError | ValueError | None = None
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write the text if possible."""
        try:
            self._stream.write(text)
        except (OSError, ValueError) as error:
            self.error = error
        return len(text)

    def flush(self) -> None:
        """Flush the stream if possible."""
        try:
            self._stream.flush()
        except (OSError, ValueError) as error:
            self.error = error

    def finish(self) -> None:
        """Flush the stream, or drop the rest of its text if that fails, so that the interpreter's last flush works."""
        self.error = None
        self.flush()
        if self.error is not None:
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


def exit_code(program: Callable[[], int | None]) -> int:
    """Run a program and return its exit code, or 1 if some of its text could not be written to stdout.

    The program continues without its output. If the disk is full, one line says so. A reader such as `head`, which has
    seen enough, causes no message.

    Args:
        program: returns its exit code. None stands for 0.
    """
    out, err = LenientStream(sys.stdout), LenientStream(sys.stderr)
    try:
        with redirect_stdout(cast(TextIO, out)), redirect_stderr(cast(TextIO, err)):
            try:
                code = program() or 0
            except SystemExit as stop:
                if stop.code:
                    raise
                code = 0  # argparse has printed its help
            out.flush()
            if code or out.error is None:
                return code
            if not isinstance(out.error, BrokenPipeError):
                warn(f"stdout: {reason_of(out.error)}")
            return FAILED
    finally:
        out.finish()
        err.finish()


def say(text: str) -> None:
    """Print to stdout, if it is still there."""
    _print(text, sys.stdout)


def warn(message: str) -> None:
    """Write one line to stderr, if it is still there. This works if logging is switched off."""
    _print(message, sys.stderr)


warn_once = cache(warn)
"""`warn`, once in a process for each message."""


def _print(text: str, stream: TextIO) -> None:
    with suppress(OSError, ValueError):
        print(text, file=stream, flush=True)


def reason_of(error: BaseException | None) -> str:
    """Return an error's reason in one line, without the file that an `OSError` names."""
    return getattr(error, "strerror", None) or first_line(error)


def file_and_reason(error: OSError) -> str:
    """Return the file that an error names, if any, and its reason, in one line."""
    reason = reason_of(error)
    return reason if error.filename is None else f"{os.fsdecode(error.filename)}: {reason}"


def duration(seconds: float) -> str:
    """Return a duration as text, in hours and minutes, minutes and seconds, or seconds."""
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s"


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the rows of a table as lines, with the first column to the left and the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["   ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows]


def invalid_action(row: int, values: Mapping[str, tuple[object, str]]) -> ValueError:
    """Return the error for an invalid action.

    Args:
        row: number of the environment.
        values: the value and the allowed values of each leaf of the action.
    """
    listed = ", ".join(f"{name}={value} ({allowed})" for name, (value, allowed) in values.items())
    return ValueError(f"step: environment {row} got {listed}")
