"""Errors of problems: whether the problem or a third-party environment is at fault; closing environments after one."""

from __future__ import annotations

import os
import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Protocol

from hpamdp.messages import ProblemError as ProblemError  # part of what environments use
from hpamdp.messages import one_line

# Frames of these packages are left out of an environment's traceback. It may call NumPy itself, but NumPy's frames do
# not show where the environment went wrong.
_NOT_THEIRS = ("hpamdp", "gymnasium", "numpy", "torch", "torchrl", "tensordict", "multiprocessing")


class EnvironmentFaultError(RuntimeError):
    """A third-party environment or callback raised an error. One line says where; the error is the cause.

    Args:
        line: the message.
        frames: the third party's own lines of the traceback, as Python prints them.
    """

    def __init__(self, line: str, frames: str = "") -> None:
        super().__init__(line, frames)  # both, so that pickling keeps both
        self.line = line
        self.frames = frames

    def __str__(self) -> str:
        """Return the line."""
        return self.line


class Closable(Protocol):
    """What can be closed, such as an environment."""

    def close(self) -> None:
        """Close it."""


@contextmanager
def closed_on_error(environment: Closable) -> Iterator[None]:
    """Close an environment if the block raises an error: it may have processes, files or a window.

    If closing fails, too, the block's error is raised all the same.
    """
    try:
        yield
    except BaseException:
        with suppress(Exception):
            environment.close()
        raise


def fault_of(error: Exception, what: str) -> EnvironmentFaultError | None:
    """Return the fault that an error is, or None if no third-party code was running.

    Args:
        error: raised while third-party code was called.
        what: who raised it, such as `my_module:Env: step`.
    """
    modules = [str(frame.f_globals.get("__name__")) for frame, _ in traceback.walk_tb(error.__traceback__)]
    theirs = [
        summary
        for module, summary in zip(modules, traceback.extract_tb(error.__traceback__), strict=True)
        if module.partition(".")[0] not in _NOT_THEIRS
    ]
    if not theirs:
        return None
    # An installed environment has frames of installed packages alone.
    theirs = [summary for summary in theirs if not _is_installed(summary.filename)] or theirs
    raised = one_line(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
    where = f"{theirs[-1].filename}, line {theirs[-1].lineno}"
    return EnvironmentFaultError(one_line(f"{what} raised {raised} ({where})"), "".join(traceback.format_list(theirs)))


def _is_installed(file: str) -> bool:
    """Return whether a file belongs to Python or to an installed package."""
    folders = {sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    return file.startswith("<frozen") or any(file.startswith(folder + os.sep) for folder in folders)
