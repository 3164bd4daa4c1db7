"""Play one hostile case in a forked process, and classify its end."""

from __future__ import annotations

import multiprocessing
import os
import resource
import tempfile
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from hpamdp.config.errors import ConfigError
from hpamdp.data import DataError
from hpamdp.env.base import ProblemError

REFUSED, ACCEPTED = "refused in one line", "accepted"
TRACEBACK, SILENT, HARM = "traceback", "wrong in silence", "harm"
BAD = (TRACEBACK, SILENT, HARM)

_PATIENCE_S = 60.0
_MOST_MEMORY_KB = 1_500_000  # beyond the memory of the process when it was forked
_ADDRESS_SPACE = 8 << 30  # bytes, so that no case takes the machine's memory
# Errors that the command line prints as one line.
_ONE_LINE = (ConfigError, DataError, ProblemError)


@dataclass(frozen=True)
class Case:
    """A hostile input.

    Attributes:
        kind: kind of the input, a row of the table.
        name: description of the input.
        act: function that uses the input in an empty folder. It returns `ACCEPTED`, or one of `BAD` with a reason after
            a colon, and lets the program's errors pass.
        must_be_refused: whether accepting the input is a wrong result.
        refusals: further errors that count as one line, such as the ValueError of a constructor.
    """

    kind: str
    name: str
    act: Callable[[Path], str]
    must_be_refused: bool = True
    refusals: tuple[type[Exception], ...] = ()


def play(case: Case) -> str:
    """Run a case in a forked process, and return its end: one of the constants, with a reason after a colon."""
    receiver, sender = multiprocessing.get_context("fork").Pipe(duplex=False)
    with tempfile.TemporaryDirectory() as folder:
        process = multiprocessing.get_context("fork").Process(target=_act, args=(case, Path(folder), sender))
        process.start()
        sender.close()
        if not receiver.poll(_PATIENCE_S):
            process.kill()
            process.join()
            return f"{HARM}: still running after {_PATIENCE_S:.0f} s"
        try:
            ending = receiver.recv()
        except EOFError:
            process.join()
            return f"{HARM}: the process ended with code {process.exitcode}"
        process.join()
        return ending


def _act(case: Case, folder: Path, sender: Connection) -> None:
    os.chdir(folder)
    torch.set_num_threads(1)
    for name, number in (("stdout.txt", 1), ("stderr.txt", 2)):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT), number)
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    ending = _ending(case, folder)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    if grown > _MOST_MEMORY_KB:
        ending = f"{HARM}: took {grown / 1e6:.1f} GB"
    sender.send(ending)


def _ending(case: Case, folder: Path) -> str:
    try:
        ending = case.act(folder)
    except (MemoryError, *_ONE_LINE, *case.refusals) as error:
        ending = REFUSED if "\n" not in str(error).strip() else f"{TRACEBACK}: several lines: {str(error)[:200]!r}"
        if isinstance(error, MemoryError) or "more memory than there is" in str(error):
            ending = f"{HARM}: asked for more memory than a case may take"
    except SystemExit as error:
        ending = f"{SILENT}: sys.exit({error.code})"
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}:{place.lineno}"
        ending = f"{TRACEBACK}: {type(error).__name__}: {str(error)[:120]!r} at {where}"
    return f"{SILENT}: accepted" if ending == ACCEPTED and case.must_be_refused else ending
