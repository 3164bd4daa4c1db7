"""Stop a run by signals, which take effect between two batches, and explain `sys.exit` in third-party code."""

from __future__ import annotations

import os
import signal
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, ClassVar

from hpamdp.children import STOP_SIGNALS
from hpamdp.messages import one_line

_URGENT = (signal.SIGINT, signal.SIGTERM)
_SAME_REQUEST_S = 1.0  # `timeout 60 make run` and some launchers deliver a signal twice


class StopRequest:
    """Record of the signals that ask a run to stop."""

    latest: ClassVar[signal.Signals | None] = None  # of all runs of this process

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._since = 0.0
        self._is_urgent = False
        StopRequest.latest = None

    @contextmanager
    def taken_at_once(self) -> Iterator[None]:
        """Let the first signal interrupt the block, which can be repeated, such as an evaluation.

        Raises:
            KeyboardInterrupt: a signal has come, before or in the block.
        """
        if self.signal is not None:
            raise KeyboardInterrupt
        self._is_urgent = True
        try:
            yield
        finally:
            self._is_urgent = False

    def note(self, number: int, frame: FrameType | None) -> None:
        """Note the signal. A Ctrl-C or SIGTERM interrupts at once if it comes over a second after the first signal.

        Raises:
            KeyboardInterrupt: the signal is the second one, or came in a block of `taken_at_once`.
        """
        now = time.monotonic()
        if self.signal is None:
            self.signal = StopRequest.latest = signal.Signals(number)
            self._since = now
        if self._is_urgent or (number in _URGENT and now - self._since > _SAME_REQUEST_S):
            self._is_urgent = False
            raise KeyboardInterrupt


@contextmanager
def stop_on_signals() -> Iterator[StopRequest]:
    """Note the signals that stop a run until the block ends. Ignored signals stay ignored.

    Only the main thread notes signals, since Python delivers them to no other thread.
    """
    request = StopRequest()
    with _handled(request.note, [each for each in _changeable_signals() if signal.getsignal(each) != signal.SIG_IGN]):
        yield request


@contextmanager
def signals_ignored() -> Iterator[None]:
    """Ignore the signals that stop a run, while it saves."""
    with _handled(signal.SIG_IGN, _changeable_signals()):
        yield


@contextmanager
def _handled(handler: Any, numbers: Sequence[signal.Signals]) -> Iterator[None]:
    """Handle these signals inside the block."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def pass_on_signal() -> None:
    """Pass the signal that stopped the last run to its earlier handler, such as a launcher that requeues jobs."""
    number = StopRequest.latest
    if number is not None and signal.getsignal(number) not in (signal.SIG_DFL, signal.default_int_handler):
        os.kill(os.getpid(), number)


def _changeable_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that this thread can handle, which are none outside the main thread."""
    return STOP_SIGNALS if threading.current_thread() is threading.main_thread() else ()


class ProgramExitError(RuntimeError):
    """Raised for a call of `sys.exit` in third-party code; the message is one line."""


@contextmanager
def exits_explained() -> Iterator[None]:
    """Turn a call of `sys.exit` inside the block into an error that names its place.

    Calls by argparse pass, and so do calls by submitit, which ends a job this way to requeue it.

    Raises:
        ProgramExitError: `sys.exit` was called.
    """
    try:
        yield
    except SystemExit as error:
        # wandb puts a function of its own before `sys.exit`.
        frames = [each for each in traceback.walk_tb(error.__traceback__) if _module(each[0]) != "wandb"]
        frame, line = frames[-1]
        if _module(frame) in ("argparse", "submitit"):
            raise
        where = f"{frame.f_code.co_filename}, line {line}"
        raise ProgramExitError(one_line(f"{where}: called sys.exit({error.code!r}), which stopped the run")) from error


def _module(frame: FrameType) -> str:
    return str(frame.f_globals.get("__name__")).partition(".")[0]
