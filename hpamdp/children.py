"""What the child processes of a run take over from it, and how they have ended."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

from hpamdp.search_path import is_clone

# Ctrl-C, a cluster's stop, the warning of SLURM and others before the time limit, and a closed terminal.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP, signal.SIGXCPU)
# If this variable is set, Python 3.11 or later does not put the working directory first.
_VARIABLE, _OURS = "PYTHONSAFEPATH", "hpamdp"


def unprotect_children() -> None:
    """Undo `children_protected`, in this process or in a child process."""
    if os.environ.get(_VARIABLE) == _OURS:
        del os.environ[_VARIABLE]


@contextmanager
def children_protected() -> Iterator[None]:
    """Make Python processes that are started inside the block look for modules in the working directory last."""
    if not is_clone(os.getcwd()):
        os.environ.setdefault(_VARIABLE, _OURS)
    try:
        yield
    finally:
        unprotect_children()


@contextmanager
def children_without(*numbers: signal.Signals) -> Iterator[None]:
    """Block these signals in all processes that this thread starts inside the block."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def how_it_ended(exit_code: int) -> str:
    """Return how a process with this exit code has ended, as text."""
    return f"exit code {exit_code}" if exit_code >= 0 else f"signal {-exit_code}, {signal.Signals(-exit_code).name}"
