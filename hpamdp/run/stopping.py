"""How a run is stopped from outside: signals are noted and take effect between two batches."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

# A Ctrl-C; a cluster's stop; what SLURM and others send before the time is up; a closed terminal.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1, signal.SIGUSR2, signal.SIGHUP, signal.SIGXCPU)
_URGENT = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """Whether a signal has asked the run to stop."""

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None

    def note(self, number: int, frame: FrameType | None) -> None:
        """Note the signal; a second Ctrl-C or SIGTERM interrupts at once.

        Raises:
            KeyboardInterrupt: it is the second.
        """
        if self.signal is not None and number in _URGENT:
            raise KeyboardInterrupt
        self.signal = signal.Signals(number)


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Note the signals that stop a run, until the block ends; those that are ignored stay so.

    In a thread other than the main one, nothing is noted: signals reach the main thread alone.
    """
    request = StopRequest()
    before = {number: signal.getsignal(number) for number in _changeable_signals()}
    handled = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}
    for number in handled:
        signal.signal(number, request.note)
    try:
        yield request
    finally:
        for number, handler in handled.items():
            signal.signal(number, handler)


@contextmanager
def signals_ignored() -> Iterator[None]:
    """Ignore the signals that stop a run, while it saves."""
    before = {number: signal.signal(number, signal.SIG_IGN) for number in _changeable_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _changeable_signals() -> tuple[signal.Signals, ...]:
    """Return the signals whose handlers this thread can set: those that stop a run, in the main thread."""
    return STOP_SIGNALS if threading.current_thread() is threading.main_thread() else ()
