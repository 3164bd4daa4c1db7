"""Write messages of one line to the user, on streams that may be closed, and end with an exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from io import TextIOWrapper

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


def exit_code(program: Callable[[], int | None]) -> int:
    """Run a program and return its exit code, or 1 if some of its text could not be written to stdout.

    The program continues without its output. If the disk is full, one line says so. A reader such as `head`, which has
    seen enough, causes no message.

    Args:
        program: returns its exit code. None stands for 0.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a letter that it cannot encode is written as its number
    _lost.clear()
    try:
        code = program() or 0
    except SystemExit as stop:
        if stop.code:
            raise
        code = 0  # argparse has printed its help
    finally:
        say("", end="")
        if _lost:  # the rest of the text is dropped, so that the interpreter's last flush works
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if code or not _lost:
        return code
    if not isinstance(_lost[0], BrokenPipeError):
        warn(f"stdout: {reason_of(_lost[0])}")
    return FAILED


# The errors of `say`.
_lost: list[OSError | ValueError] = []


def say(text: str, end: str = "\n") -> None:
    """Print to stdout, if it is still there."""
    try:
        print(text, end=end, flush=True)
    except (OSError, ValueError) as error:
        _lost.append(error)


def warn(message: str) -> None:
    """Write one line to stderr, if it is still there. This works if logging is switched off."""
    with suppress(OSError, ValueError):
        print(message, file=sys.stderr, flush=True)


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
