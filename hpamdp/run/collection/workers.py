"""Base class of collections in several processes."""

from __future__ import annotations

import sys
import threading
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from functools import partial
from typing import Any, ClassVar, NoReturn, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from tqdm import tqdm

from hpamdp import keys
from hpamdp.cards import CollectorCard
from hpamdp.children import children_protected
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config
from hpamdp.env.base import ProblemError
from hpamdp.env.errors import EnvironmentFaultError
from hpamdp.limits import limit_of
from hpamdp.messages import first_line
from hpamdp.run.assemble import AssembledRun
from hpamdp.run.collection.base import Collection, CollectionError, WorkerDiedError, check_state, random_seeds
from hpamdp.run.collection.options import WorkerOptions
from hpamdp.run.collection.worker import EnvShard, RemoteError, pack_state

_PATIENCE_S = 2.0  # for workers in the middle of a batch that is no longer needed

_Returned = TypeVar("_Returned")


class WorkerCollection(Collection):
    """Steps an equal part of the environments in each of `num_workers` processes, on the CPU with one thread.

    Environment `i` has the same episodes as in a single process. Only exploration uses other random numbers, and each
    worker has its own generator. Before each batch, all workers get the policy's weights and buffers. They wait for
    each other and for the learner.

    With `ahead`, workers begin the next batch as soon as they have returned one. They use the policy from before the
    agent learned from that batch, so the data does not depend on timing. A checkpoint includes the unfinished batch.

    Each worker has a TorchRL collector. Threads call it, and the main thread waits for them, where a signal reaches it.
    If a worker dies, the others keep their episodes and their part of the batch. Its replacement begins new episodes,
    with new seeds, and collects the missing part.

    A subclass starts a worker in `_start`, ends it in `kill`, and explains its death in `_death`.
    """

    Options: ClassVar[type[WorkerOptions]] = WorkerOptions
    card = CollectorCard(has_workers=True)
    options: WorkerOptions

    def __init__(
        self, config: Config, parts: AssembledRun, frames: int, options: WorkerOptions | None = None, **settings: Any
    ) -> None:
        self.options = self.Options.of(options, settings)
        num_workers = self.options.num_workers
        self.name = str(config.collector)
        self._config = config
        self._frames = frames
        self._restarts = 0
        self._parts = parts
        self._policy = parts.policy
        self._specs = parts.agent.specs
        self._frozen = pack_state(parts.agent.router) if config.run.low.freeze else None
        self._device = parts.device
        self._problem = parts.env.base_env  # never stepped; it has the statistics of all workers
        self._keeps_episodes = parts.env.keeps_episodes
        self._num_envs = config.run.num_envs
        self._size = config.run.num_envs // num_workers
        self._state: dict[str, Any] = {"env": {}}  # the last known one; it has no episodes before the first
        self._is_idle = False
        self.workers: list[Any] = [None] * num_workers  # TorchRL's collector of each
        self._batches: list[TensorDictBase | None] = [None] * num_workers  # the memory that each writes to
        self._new_statistics: list[dict[str, Tensor]] = [{}] * num_workers  # of each worker's last batch
        self._cpu_s = [0.0] * num_workers
        self._cpu_s_of_dead = 0.0
        self._coming: list[Future[TensorDictBase]] = []
        self._collect: Callable[[int], TensorDictBase]  # gives a worker's part of what is coming
        try:
            with children_protected():
                statistics = self._on_all(lambda worker: call_worker(worker, "take_new_statistics"))
            for new in statistics:
                self._problem.add_statistics(new)
        except BaseException:
            self.close()
            raise
        self._is_idle = True

    @abstractmethod
    def _start(self, shard: EnvShard) -> Any:
        """Start a worker and return its TorchRL collector, which runs a `ShardCollector` there."""
        raise NotImplementedError

    @abstractmethod
    def kill(self, worker: Any) -> None:
        """End a worker at once."""
        raise NotImplementedError

    @abstractmethod
    def _death(self, worker: Any | None, error: Exception) -> str | None:
        """Return as text how a worker died; None if the error of a call to it has another cause.

        Args:
            worker: the worker's TorchRL collector; None while it starts.
            error: the error of the call.
        """
        raise NotImplementedError

    def _shard(self, worker: int, restart: int = 0) -> EnvShard:
        """Return a worker's part of the environments.

        Args:
            worker: the worker's number.
            restart: 0 for a first worker; the number of the restart for a replacement.
        """
        seed, first = self._config.run.seed, worker * self._size
        # Each worker has its own random numbers, which change if a run is resumed.
        exploration_seed, fresh_seed = random_seeds(seed, first, self._frames, restart)
        begins_anew = restart > 0 or (self._frames > 0 and not self._keeps_episodes)
        env_seed = fresh_seed if begins_anew else seed
        return EnvShard(self._config, self._specs, first, self._size, env_seed, exploration_seed, self._frozen)

    def _raise_explained(self, number: int, error: Exception) -> NoReturn:
        """Raise an error of a worker, with a message of one line if it died or the machine reached a limit.

        Raises:
            WorkerDiedError: the worker died.
            CollectionError: the machine reached a limit.
            ConfigError: the environment cannot be made in a worker.
        """
        if isinstance(error, ProblemError | EnvironmentFaultError | MemoryError | RemoteError):
            raise error
        if isinstance(error, ConfigError):  # a worker's, to which TorchRL adds the traceback
            raise ConfigError(first_line(error)) from error
        limit = limit_of(error)
        if limit is not None:
            raise CollectionError(f"{self.name}: {limit}") from error
        death = self._death(self.workers[number], error)
        if death is not None:
            raise WorkerDiedError(f"{self.name}: worker {number} of {len(self.workers)} died ({death})") from error
        raise error

    def _on(self, number: int, call: Callable[[Any], _Returned]) -> _Returned:
        """Return the result of a call to a worker. A missing worker is started first.

        Raises:
            CollectionError: the worker died, or this machine reached a limit.
        """
        try:
            if self.workers[number] is None:
                self.workers[number] = self._start(self._shard(number, self._restarts))
            return call(self.workers[number])
        except Exception as error:
            self._raise_explained(number, error)

    def _on_all(self, call: Callable[[Any], _Returned]) -> list[_Returned]:
        """Return the results of a call to all workers in parallel, in their order."""
        return self._in_parallel(lambda number: self._on(number, call))

    def _in_parallel(self, call: Callable[[int], _Returned]) -> list[_Returned]:
        """Return the results of a function for the number of every worker, in their order."""
        calls = self._in_threads(call)
        wait(calls)
        return [each.result() for each in calls]

    def _in_threads(self, call: Callable[[int], _Returned]) -> list[Future[_Returned]]:
        """Call a function with the number of every worker in parallel."""
        return [_in_thread(call, number) for number in range(len(self.workers))]

    def _results(self, calls: list[Future[_Returned]], call: Callable[[int], _Returned]) -> list[_Returned]:
        """Wait for calls in threads. Replace the workers that die, and call again.

        Raises:
            CollectionError: a worker died and is not replaced, or this machine reached a limit.
        """
        wait(calls)
        while deaths := _deaths(calls):
            if self._restarts + len(deaths) > self.options.max_restarts:
                raise next(iter(deaths.values()))
            for number, death in deaths.items():
                self._remove(number, death)
            with self.while_replacing(), children_protected():
                for number in deaths:
                    calls[number] = _in_thread(call, number)
                wait(calls)
        return [each.result() for each in calls]

    def _remove(self, number: int, death: WorkerDiedError) -> None:
        """Remove the remains of a dead worker, and count the restart that follows."""
        self._restarts += 1
        line = f"{death}; starting another (restart {self._restarts} of {self.options.max_restarts})"
        tqdm.write(line, file=sys.stderr)  # above the bar of the training
        self._end(number)
        self._batches[number] = None
        self._cpu_s_of_dead += self._cpu_s[number]
        self._cpu_s[number] = 0.0

    def next(self) -> TensorDictBase:
        """Send the policy's state and collect a batch. With `ahead`, return the batch that was begun and begin another.

        Raises:
            CollectionError: a worker died and is not replaced, or this machine reached a limit.
        """
        self._is_idle = False
        policy = pack_state(self._policy)
        if not self._coming:
            self._begin(policy)
        batch = self._finished()
        for number, new in enumerate(self._new_statistics):
            if new:
                self._problem.add_statistics(new)
            self._new_statistics[number] = {}
        self._coming = []
        if self.options.ahead:
            self._begin(policy)
        if "coming" in self._state:  # the batch to return, from which a resumed run must not learn again
            self._state = {name: value for name, value in self._state.items() if name != "coming"}
        self._is_idle = True
        return batch.to(self._device)

    def _begin(self, policy: bytes) -> None:
        """Have all workers collect their part of a batch."""
        self._collect = partial(self._part, policy, self._problem.statistics())
        self._coming = self._in_threads(self._collect)

    def _finished(self) -> TensorDictBase:
        """Wait for all parts of the batch, and return a copy of them in the workers' order."""
        return torch.cat(self._results(self._coming, self._collect))

    def _part(self, policy: bytes, statistics: Mapping[str, Tensor], number: int) -> TensorDictBase:
        result = self._on(number, lambda worker: call_worker(worker, "collect", policy, statistics))
        self._cpu_s[number], self._new_statistics[number] = result.cpu_s, result.statistics
        self.cpu_s = self._cpu_s_of_dead + sum(self._cpu_s)
        if result.batch is not None:
            self._batches[number] = result.batch
        collected = self._batches[number]
        assert collected is not None
        return collected

    def state(self) -> dict[str, Any]:
        """Return the concatenated states of the workers. If a worker fails, return the last known states.

        Without known states, a resumed run begins new episodes. The scale of observations is always the present one.

        `generators` holds the state of each worker's random generator. `coming` holds the next batch to return, if it
        has been collected.
        """
        if not self._is_idle or any(part.exception() for part in self._coming):
            return self._last_known()
        try:
            states = self._on_all(self._state_of)
        except CollectionError:  # the next batch replaces the worker or raises it again
            return self._last_known()
        state: dict[str, Any] = {"generators": [each["generator"] for each in states]}
        for name in states[0].keys() & {"env", "root"}:
            state[name] = _side_by_side([each[name] for each in states])
        if not self._keeps_episodes:
            state["env"] = self._problem.env_state()
        if self._coming:
            state["coming"] = self._finished().to_dict()
        self._state = state
        return self._state

    def _last_known(self) -> dict[str, Any]:
        return self._state if self._keeps_episodes else {**self._state, "env": self._problem.env_state()}

    def _state_of(self, worker: Any) -> dict[str, Any]:
        state = {"generator": call_worker(worker, "policy.generator_state")}
        if self._keeps_episodes:
            state["env"] = call_worker(worker, "env.env_state")
            state["root"] = call_worker(worker, "_carrier.to_dict")
        return state

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state` of any collection. Exploration is the same only with the same number of workers."""
        check_state(state, self._parts.env)
        self._state = dict(state)
        self._is_idle = False
        env, root, generators = state["env"], state.get("root"), state.get("generators", ())
        if env and not self._keeps_episodes:
            self._problem.set_env_state(env)

        def send(number: int) -> None:
            first = number * self._size
            own = slice(first, first + self._size)

            def send_to(worker: Any) -> None:
                if env and self._keeps_episodes:
                    call_worker(worker, "env.set_env_state", _rows(env)[own].cpu().to_dict())
                elif env:
                    call_worker(worker, "begin_episodes", env)
                elif self._keeps_episodes and self._frames > 0:  # not the run's first episodes again
                    call_worker(worker, "begin_seeded", random_seeds(self._config.run.seed, first, self._frames)[1])
                if root is not None and self._keeps_episodes:
                    call_worker(worker, "_carrier.update", _rows(root)[own].cpu().to_dict())
                if len(generators) == len(self.workers):
                    call_worker(worker, "policy.set_generator_state", generators[number])

            self._on(number, send_to)

        self._results(self._in_threads(send), send)
        if "coming" in state:
            shape = state["coming"]["next"][keys.DONE].shape
            coming = TensorDict(state["coming"], batch_size=shape[:-1])
            self._collect = coming.split(self._size).__getitem__
            self._coming = self._in_threads(self._collect)
        self._is_idle = True

    def close(self) -> None:
        """End the workers that have started, after a short wait for the unfinished batch."""
        begun = [part for part, worker in zip(self._coming, self.workers, strict=False) if worker is not None]
        wait(begun, _PATIENCE_S)
        for part, worker in zip(self._coming, self.workers, strict=False):
            if worker is not None and not part.done():
                self.kill(worker)
        wait(begun, _PATIENCE_S)
        self._in_parallel(self._end)

    def _end(self, number: int) -> None:
        worker, self.workers[number] = self.workers[number], None
        if worker is not None:
            worker.shutdown()
            torch.set_num_threads(self._config.run.threads)  # which TorchRL raises


def call_worker(worker: Any, method: str, *arguments: Any) -> Any:
    """Return what a method of a worker's collector returns."""
    (returned,) = worker.map_fn(method, [arguments])
    return returned


def _in_thread(call: Callable[[int], _Returned], number: int) -> Future[_Returned]:
    """Call a function in a thread of its own, for which the end of the process does not wait."""
    future: Future[_Returned] = Future()

    def run() -> None:
        try:
            future.set_result(call(number))
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future


def _deaths(calls: Sequence[Future[Any]]) -> dict[int, WorkerDiedError]:
    """Return the errors of the calls whose workers died, by the workers' numbers."""
    errors = enumerate(each.exception() for each in calls)
    return {number: error for number, error in errors if isinstance(error, WorkerDiedError)}


def _side_by_side(states: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Concatenate nested columns. A worker that has just begun has no actions yet, so only what all have is kept."""
    rows = [_rows(each) for each in states]
    shared = set.intersection(*({*each.keys(include_nested=True, leaves_only=True)} for each in rows))
    return TensorDict.cat([each.select(*shared) for each in rows]).to_dict()


def _rows(columns: Mapping[str, Any]) -> TensorDict:
    """Return nested columns, all with the same first dimension, as rows."""
    return TensorDict(columns).auto_batch_size_(1)
