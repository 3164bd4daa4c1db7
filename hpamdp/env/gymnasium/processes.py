"""Copies of a Gymnasium environment in worker processes of Gymnasium's AsyncVectorEnv, for slow environments.

To Gymnasium, each worker is one environment. Its action is a table of actions, and its observation the table of results
of all copies in it. So a step sends one message to each worker, and the copies of a worker rest between their episodes.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import logger, spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from hpamdp.env.errors import EnvironmentFaultError, ProblemError, closed_on_error
from hpamdp.env.gymnasium.copies import Copies
from hpamdp.env.gymnasium.making import Maker
from hpamdp.env.gymnasium.options import GymnasiumOptions
from hpamdp.env.registration import register
from hpamdp.messages import warn
from hpamdp.search_path import protect_children, unprotect_children
from hpamdp.settings import SettingError

_PATIENCE_S = 2.0  # until a dead process has an exit code
_SILENT = 100  # a level of Gymnasium's logger
# A terminal sends Ctrl-C to every process, and only the run's own process may act on it.
_SIGNALS_OF_THE_RUN = (signal.SIGINT, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2)
# Columns of a table of actions: the discrete actions of all components follow, then the parameters.
_IS_STEPPED, _OPTION, _DISCRETE = 0, 1, 2


@dataclass(frozen=True)
class _Block:
    """Some of the copies, which one worker steps. Calling it makes the worker's environment.

    Attributes:
        make, settings, flattens_pictures: as for `Copies`.
        first: number of the first copy.
        num: number of copies.
        num_rows: number of rows of the tables, the same in all workers.
        num_columns: of the tables of actions, of results and of pixels.
    """

    make: Maker
    settings: GymnasiumOptions
    flattens_pictures: bool
    first: int
    num: int
    num_rows: int
    num_columns: tuple[int, int, int]

    def __call__(self) -> gymnasium.Env:
        return _BlockEnv(self)


class _BlockEnv(gymnasium.Env):
    """The copies of one worker as an environment, which are made at the first reset."""

    def __init__(self, block: _Block) -> None:
        self._block = block
        self._copies: Copies | None = None
        of_actions, of_results, of_pixels = block.num_columns
        self.action_space = spaces.Box(-np.inf, np.inf, (block.num_rows, of_actions), np.float64)
        tables: list[spaces.Space] = [spaces.Box(-np.inf, np.inf, (block.num_rows, of_results), np.float64)]
        if of_pixels:
            tables.append(spaces.Box(0, 255, (block.num_rows, of_pixels), np.uint8))
        self.observation_space = spaces.Tuple(tables)
        self._table = np.zeros((block.num_rows, of_results))
        self._pixels = np.zeros((block.num_rows, of_pixels), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict]:
        """Begin episodes of the copies whose `seeds` are in the options."""
        block = self._block
        if self._copies is None:
            unprotect_children()
            register()
            self._copies = Copies(block.make, block.num, block.settings, block.flattens_pictures, block.first)
        seeds = {row - block.first: seed for row, seed in (options or {})["seeds"].items()}
        self._copies.reset({row: seed for row, seed in seeds.items() if 0 <= row < block.num})
        return self._results(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        """Take the steps of a table of actions."""
        assert self._copies is not None
        actions = action[: self._block.num]
        rows = np.flatnonzero(actions[:, _IS_STEPPED]).tolist()
        option = actions[:, _OPTION].astype(np.int64)
        num_components = self._copies.actions.num_components
        first_parameter = _DISCRETE + num_components
        discrete = actions[:, _DISCRETE:first_parameter].astype(np.int64)
        if num_components == 1:
            discrete = discrete[:, 0]
        has_options = self._copies.options.num_options > 0
        self._copies.step(rows, option if has_options else None, discrete, actions[:, first_parameter:])
        return self._results(), 0.0, False, False, {}

    def close(self) -> None:
        """Close the copies."""
        if self._copies is not None:
            self._copies.close()

    def pictures(self, num: int) -> list[np.ndarray]:
        """Return the pictures of this worker's copies among the first `num` of all."""
        assert self._copies is not None
        return self._copies.pictures(max(0, num - self._block.first))

    def call(self, method: str, *arguments: Any) -> list[Any]:
        """Return what a method returns for each of this worker's copies."""
        assert self._copies is not None
        return self._copies.call(method, *arguments)

    def _results(self) -> tuple[np.ndarray, ...]:
        assert self._copies is not None
        self._table[: self._block.num] = self._copies.table
        if not self._pixels.size:
            return (self._table,)
        self._pixels[: self._block.num] = self._copies.pixels
        return self._table, self._pixels


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
        options, actions, observations, layout, table, results, pixels: as those of `Copies`.
        envs: empty, since the copies live elsewhere.
        example: a closed copy, to read its spaces.

    Raises:
        SettingError: the spaces are not accepted, or this process may not start others.
        EnvironmentFaultError: a constructor raised an error.
    """

    def __init__(self, make: Maker, num: int, settings: GymnasiumOptions, flattens_pictures: bool = False) -> None:
        self._name = make.name
        self._is_broken = False
        self.envs: list[gymnasium.Env] = []
        probe = Copies(make, 1, settings, flattens_pictures)
        probe.close()
        self.example = probe.example
        self.max_steps, self.option_names, self.layout = probe.max_steps, probe.option_names, probe.layout
        self.first_info, self.usual_length = probe.first_info, probe.usual_length
        self.has_pictures, self.pictures_per_second = probe.has_pictures, probe.pictures_per_second
        self.options, self.actions, self.observations = probe.options, probe.actions, probe.observations
        self.table = np.zeros((num, self.layout.num_result_columns))
        self.results = self.layout.results(self.table)
        self.pixels = np.zeros((num, self.layout.num_pixels), np.uint8)
        rows = -(-num // settings.num_workers)
        self._first_parameter = _DISCRETE + self.actions.num_components
        of_actions = self._first_parameter + sum(self.actions.parameter_dims)
        columns = (of_actions, self.layout.num_result_columns, self.layout.num_pixels)
        blocks = [
            _Block(make, settings, flattens_pictures, first, min(rows, num - first), rows, columns)
            for first in range(0, num, rows)
        ]
        self._table_of_actions = np.zeros((len(blocks) * rows, columns[0]))
        self._shape_of_actions = (len(blocks), rows, columns[0])
        with _starting():
            self._vector = AsyncVectorEnv(blocks, copy=False, context="spawn", autoreset_mode=AutoresetMode.DISABLED)
        with closed_on_error(self):
            self.reset({})  # makes the copies, so that a fault of a constructor is raised here

    def reset(self, seeds: Mapping[int, int | None]) -> None:
        """Begin episodes; see `Copies.reset`."""
        with self._explained():
            tables, _ = self._vector.reset(options={"seeds": dict(seeds)})
        self._keep(tables)

    def step(self, rows: list[int], option: np.ndarray | None, discrete: np.ndarray, parameters: np.ndarray) -> None:
        """Take a step with some copies; see `Copies.step`."""
        num = len(discrete)
        actions = self._table_of_actions
        actions[:, _IS_STEPPED] = 0.0
        actions[rows, _IS_STEPPED] = 1.0
        if option is not None:
            actions[:num, _OPTION] = option
        actions[:num, _DISCRETE : self._first_parameter] = discrete.reshape(num, -1)
        actions[:num, self._first_parameter :] = parameters
        with self._explained():
            tables = self._vector.step(actions.reshape(self._shape_of_actions))[0]
        self._keep(tables)

    def pictures(self, num: int) -> list[np.ndarray]:
        """Return pictures of the first `num` copies; see `Copies.pictures`."""
        with self._explained():
            pictures = self._vector.call("pictures", num)
        return [picture for of_worker in pictures for picture in of_worker]

    def call(self, method: str, *arguments: Any) -> list[Any]:
        """Return what a method of the environments returns for each copy; see `Copies.call`."""
        with self._explained():
            values = self._vector.call("call", method, *arguments)
        return [value for of_worker in values for value in of_worker]

    def _keep(self, tables: Sequence[np.ndarray]) -> None:
        own_tables: tuple[np.ndarray, ...] = (self.table, self.pixels)
        for own, table in zip(own_tables, tables, strict=False):  # without pictures, workers send no pixels
            own[:] = table.reshape(-1, table.shape[-1])[: len(own)]

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Raise an error of a worker as it was raised there, and say which worker died."""
        # Otherwise Gymnasium also warns, with the worker's whole traceback.
        level, logger.min_level = logger.min_level, _SILENT
        try:
            yield
        except (ProblemError, EnvironmentFaultError, SettingError) as error:
            self._is_broken = True
            # Gymnasium makes another error of the same class, whose argument is the worker's.
            raise (error.args[0] if isinstance(error.args[0], type(error)) else error) from None
        except (EOFError, OSError) as error:
            self._is_broken = True
            raise ProblemError(f"{self._name}: {self._death()}") from error
        finally:
            logger.min_level = level

    def _death(self) -> str:
        workers = self._vector.processes
        how = {}
        for number, worker in enumerate(workers):
            worker.join(_PATIENCE_S / len(workers))
            code = worker.exitcode
            if code is not None:
                how[number] = f"exit code {code}" if code >= 0 else f"signal {-code}, {signal.Signals(-code).name}"
        if not how:
            return "a worker no longer answers"
        # A worker that was closed has the exit code 0.
        number = min(how, key=lambda each: how[each] == "exit code 0")
        return f"worker {number} of {len(workers)} died ({how[number]})"

    def close(self) -> None:
        """Close the copies and end the workers; if one has died, warn and let the run go on."""
        if not self._is_broken:
            try:
                self._vector.close()
                return
            except (EOFError, OSError):
                warn(f"{self._name}: {self._death()} before it was closed; the run goes on")
        for worker in self._vector.processes:
            worker.kill()
            worker.join()
        self._vector.closed = True  # it would wait for the dead ones


@contextmanager
def _starting() -> Iterator[None]:
    """Let processes that are started inside the block leave signals and modules to the run's process."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS_OF_THE_RUN)
    protect_children()
    try:
        yield
    finally:
        unprotect_children()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
