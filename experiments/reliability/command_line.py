"""Run the command line in processes forked after the imports, so that hundreds of runs take only minutes."""

from __future__ import annotations

import multiprocessing
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import torch

import hpamdp.run.train  # noqa: F401  # what every run imports
from hpamdp import cli

REPOSITORY = Path(__file__).parents[2]


@dataclass(frozen=True)
class Ending:
    """The end of a run.

    Attributes:
        code: exit code. If negative, the signal that killed the run. If None, the run exceeded its time.
        errors: lines on stderr, without progress bars.
    """

    code: int | None
    errors: tuple[str, ...]

    @property
    def is_one_line(self) -> bool:
        """Whether the run reported a mistake, or another end, in one line."""
        return self.code not in (0, None) and len(self.errors) == 1 and "Traceback" not in self.errors[0]


def start(words: list[str], folder: Path) -> multiprocessing.Process:
    """Start `run.py` with these words in a separate process, with `folder` as its working directory."""
    folder.mkdir(parents=True, exist_ok=True)
    process = multiprocessing.get_context("fork").Process(target=_main, args=(words, folder))
    process.start()
    return process


def finish(process: multiprocessing.Process, folder: Path, seconds: float = 120.0) -> Ending:
    """Wait for a run, and kill it if it takes longer than `seconds`."""
    process.join(seconds)
    code = process.exitcode
    if code is None:
        process.kill()
        process.join()
    return Ending(code, _lines(folder / "stderr.txt"))


def run(words: list[str], folder: Path, seconds: float = 120.0) -> Ending:
    """Run the command line to its end."""
    return finish(start(words, folder), folder, seconds)


def _lines(file: Path) -> tuple[str, ...]:
    if not file.is_file():
        return ()
    # A progress bar rewrites its line after a carriage return.
    lines = (line.split("\r")[-1].strip() for line in file.read_text(errors="replace").splitlines())
    return tuple(
        line for line in lines if line and "it/s" not in line and "steps/s" not in line and "?" not in line[:40]
    )


def _main(words: list[str], folder: Path) -> None:
    os.chdir(folder)
    for name, number in (("stdout.txt", 1), ("stderr.txt", 2)):
        file = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, number)
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115  # pytest and notebooks replace these
    sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
    sys.argv = [str(REPOSITORY / "run.py"), *words]
    torch.set_num_threads(1)
    cli.main()
