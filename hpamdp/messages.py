"""Words for the user: one line each, on streams that may be gone."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, TextIO, cast


def one_line(text: object) -> str:
    """Return a text or an error's message as one line, with a space in place of every line break.

    Other characters that control a terminal, such as those of escape sequences, become question marks.
    """
    line = " ".join(line for line in map(str.strip, str(text).expandtabs().splitlines()) if line)
    return "".join(character if character.isprintable() else "?" for character in line)


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
    """A text stream on which writing never fails.

    If the terminal was closed or the disk is full, only the text is lost. A letter that the stream cannot show is
    written as its number.

    Args:
        stream: where the text goes. If None, as `sys.stderr` is if it was closed, the text goes nowhere.

    Attributes:
        error: the last error that lost some text; None if all text was written.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream
        self.error: OSError | ValueError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write the text if possible."""
        if self._stream is None:
            return len(text)
        try:
            self._stream.write(text)
        except UnicodeEncodeError:
            encoding = self._stream.encoding
            self.write(text.encode(encoding, "backslashreplace").decode(encoding))
        except (OSError, ValueError) as error:
            self.error = error
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write the lines if possible."""
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        """Flush the stream if possible."""
        if self._stream is None:
            return
        try:
            self._stream.flush()
        except (OSError, ValueError) as error:
            self.error = error

    def isatty(self) -> bool:
        """Return whether the stream is a terminal."""
        if self._stream is not None:
            with suppress(OSError, ValueError):
                return self._stream.isatty()
        return False


@contextmanager
def lenient_streams() -> Iterator[None]:
    """Let printing inside the block never fail, nor the interpreter's flush of stdout and stderr at its end."""
    before = sys.stdout, sys.stderr
    out, err = (stream if stream is None else LenientStream(stream) for stream in before)
    sys.stdout, sys.stderr = cast(TextIO, out), cast(TextIO, err)
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before
        for stream in (out, err):
            if stream is not None:
                _finish(stream)


def _finish(stream: LenientStream) -> None:
    """Flush a stream; if that fails, drop the rest of its text."""
    stream.error = None
    stream.flush()
    if stream.error is not None:
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def lost_output() -> OSError | ValueError | None:
    """Return the error that lost some of the text on stdout, if there was one."""
    sys.stdout.flush()
    return getattr(sys.stdout, "error", None)


def say(text: str) -> None:
    """Print to stdout, if it is still there."""
    _print(text, sys.stdout)


def warn(message: str) -> None:
    """Write one line to stderr, if it is still there; the logging module may be switched off."""
    _print(message, sys.stderr)


def _print(text: str, stream: TextIO | None) -> None:
    lenient = LenientStream(stream)
    lenient.write(f"{text}\n")
    lenient.flush()
    if lenient.error is not None:
        _finish(lenient)  # else the interpreter fails once more at its end


def reason_of(error: BaseException | None) -> str:
    """Return in one line what went wrong, without the file that an `OSError` names."""
    return getattr(error, "strerror", None) or first_line(error)


def file_and_reason(error: OSError) -> str:
    """Return in one line the file that an error is about, if it names one, and what went wrong."""
    reason = reason_of(error)
    return reason if error.filename is None else f"{os.fsdecode(error.filename)}: {reason}"


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
