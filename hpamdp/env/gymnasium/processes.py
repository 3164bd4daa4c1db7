"""Copies of a Gymnasium environment in worker processes, for slow environments.

Each worker has some of the copies. It answers the call of one of their methods with what the method returns, and with
their results. So a step sends one message to each worker, and gets one back.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector.utils import CloudpickleWrapper

from hpamdp.children import children_protected, children_without, how_it_ended, unprotect_children
from hpamdp.env.errors import ProblemError, closed_on_error
from hpamdp.env.gymnasium.copies import Copies
from hpamdp.env.gymnasium.making import Maker
from hpamdp.env.gymnasium.options import GymnasiumOptions
from hpamdp.env.registration import register
from hpamdp.messages import warn

START_METHOD = "spawn"
_PATIENCE_S = 2.0  # until a dead process has an exit code
# A terminal sends Ctrl-C to every process, and only the run's own process may act on it.
_SIGNALS_OF_THE_RUN = (signal.SIGINT, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)


class ProcessCopies:
    """As `Copies`, except that up to `settings.num_workers` processes each step a part of the copies.

    One more copy is made in this process, to read its spaces.

    Args:
        make: makes a copy; can be pickled.
        num: number of copies.
        settings: how the spaces are read.
        flattens_pictures: whether pictures are part of the vectors.

    Attributes:
        max_steps, usual_length, option_names, first_info, has_pictures, pictures_per_second: as those of `Copies`.
        options, actions, observations, results: as those of `Copies`.
        envs: empty, since the copies live elsewhere.
        example: a closed copy, to read its spaces.

    Raises:
        SettingError: the spaces are not accepted, or this process may not start others.
        EnvironmentFaultError: a constructor raised an error.
    """

    def __init__(self, make: Maker, num: int, settings: GymnasiumOptions, flattens_pictures: bool = False) -> None:
        self._name = make.name
        self._is_waiting = False  # for an answer; it stays true if an error ends the wait
        self._cause = "its workers were interrupted in the middle of a step; make a new one"
        self.envs: list[gymnasium.Env] = []
        probe = Copies(make, 1, settings, flattens_pictures)
        with closing(probe):
            self.usual_length = probe.usual_length
        self.example = probe.example
        self.max_steps, self.option_names = probe.max_steps, probe.option_names
        self.first_info = probe.first_info
        self.has_pictures, self.pictures_per_second = probe.has_pictures, probe.pictures_per_second
        self.options, self.actions, self.observations = probe.options, probe.actions, probe.observations
        self.results = probe.results.changed(lambda array: np.zeros((num, *array.shape[1:]), array.dtype))
        rows = -(-num // settings.num_workers)
        self._blocks = [range(first, min(first + rows, num)) for first in range(0, num, rows)]
        context: Any = multiprocessing.get_context(START_METHOD)
        self._pipes: list[Connection] = []
        self._workers: list[Any] = []
        with closed_on_error(self):
            with children_protected(), children_without(*_SIGNALS_OF_THE_RUN):
                for block in self._blocks:
                    pipe, theirs = context.Pipe()
                    made: Any = partial(Copies, make, len(block), settings, flattens_pictures, block.start)
                    worker = context.Process(target=_serve, args=(theirs, CloudpickleWrapper(made)), daemon=True)
                    worker.start()
                    theirs.close()
                    self._pipes.append(pipe)
                    self._workers.append(worker)
            self.reset({})  # makes the copies, so that a fault of a constructor is raised here

    def reset(self, seeds: Mapping[int, int | None]) -> None:
        """Begin episodes; see `Copies.reset`."""
        self._ask(
            "reset", [({row - own.start: seed for row, seed in seeds.items() if row in own},) for own in self._blocks]
        )

    def step(self, rows: list[int], option: np.ndarray | None, discrete: np.ndarray, parameters: np.ndarray) -> None:
        """Take a step with some copies; see `Copies.step`."""
        given = []
        for own in self._blocks:
            of_block = slice(own.start, own.stop)
            options = None if option is None else option[of_block]
            stepped = [row - own.start for row in rows if row in own]
            given.append((stepped, options, discrete[of_block], parameters[of_block]))
        self._ask("step", given)

    def pictures(self, num: int) -> list[np.ndarray]:
        """Return pictures of the first `num` copies; see `Copies.pictures`."""
        answers = self._ask("pictures", [(max(0, num - own.start),) for own in self._blocks])
        return [picture for of_worker in answers for picture in of_worker]

    def call(self, method: str, *arguments: Any) -> list[Any]:
        """Return what a method of the environments returns for each copy; see `Copies.call`."""
        answers = self._ask("call", [(method, *arguments)] * len(self._blocks))
        return [value for of_worker in answers for value in of_worker]

    def _ask(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
        """Call a method of the copies in every worker, keep their results, and return what it returned.

        Raises:
            ProblemError: a worker has died, or the wait for an earlier answer was interrupted.
        """
        if self._is_waiting:
            raise ProblemError(f"{self._name}: {self._cause}")
        self._is_waiting = True
        try:
            for pipe, given in zip(self._pipes, arguments, strict=True):
                pipe.send((method, given))
            answers = [pipe.recv() for pipe in self._pipes]
        except (EOFError, OSError) as error:
            self._cause = self._death()
            raise ProblemError(f"{self._name}: {self._cause}") from error
        self._is_waiting = False
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
        for own, (_, results) in zip(self._blocks, answers, strict=True):
            for ours, theirs in zip(self.results.arrays(), results.arrays(), strict=True):
                ours[own.start : own.stop] = theirs
        return [returned for returned, _ in answers]

    def _death(self) -> str:
        """Return which worker has died, and how."""
        for number, worker in enumerate(self._workers):
            worker.join(_PATIENCE_S / len(self._workers))
            if worker.exitcode is not None:
                return f"worker {number} of {len(self._workers)} died ({how_it_ended(worker.exitcode)})"
        return "a worker no longer answers"

    def close(self) -> None:
        """Close the copies and end the workers; if one has died, warn and let the run go on."""
        for pipe in self._pipes:
            pipe.close()
        for worker in self._workers:
            if self._is_waiting:
                worker.kill()
            worker.join()
        if not self._is_waiting and any(worker.exitcode for worker in self._workers):
            warn(f"{self._name}: {self._death()} before it was closed; the run goes on")
        self._pipes, self._workers = [], []


def _serve(pipe: Connection, make: CloudpickleWrapper) -> None:
    """Answer calls of the methods of copies, which the first call makes, until the pipe is closed."""
    unprotect_children()
    register()
    copies: Any = None
    with suppress(EOFError, OSError):  # the run has closed the pipe, or has ended
        while True:
            method, given = pipe.recv()
            answer: Any
            try:
                copies = make() if copies is None else copies
                answer = getattr(copies, method)(*given), copies.results
            except Exception as error:
                answer = error
            pipe.send(answer)
    if copies is not None:
        copies.close()
