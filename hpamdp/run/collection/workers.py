"""What collections in several processes share."""

from __future__ import annotations

import signal
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from hpamdp import keys
from hpamdp.config import Config
from hpamdp.run.assemble import Parts
from hpamdp.run.collection.base import Collection, WorkerDiedError
from hpamdp.run.collection.worker import EnvShard, packed
from hpamdp.search_path import protect_children, unprotect_children


class WorkerCollection(Collection):
    """Steps an equal shard of the environments in each of `num_workers` processes, on the CPU with one thread.

    Environment `i` has the same episodes as in a single process; only exploration uses other random numbers, one
    stream for each worker. Before each batch, all workers get the policy's weights and buffers; they wait for one
    another and for the learner.

    With `ahead`, workers begin the next batch as soon as one is handed out, by the policy from before anything was
    learned from that one. What is collected does not depend on how long either takes. A batch that is on its way when
    the run is saved is saved with it.

    A subclass starts TorchRL's collector in `_start`.
    """

    has_workers: ClassVar[bool] = True

    def __init__(self, config: Config, parts: Parts, frames: int, num_workers: int, *, ahead: bool) -> None:
        self._ahead = ahead
        self._coming: Future[TensorDictBase] | None = None
        self._policy = parts.policy
        self._device = parts.device
        self._keeps_episodes = parts.env.keeps_episodes
        self._num_envs = config.run.num_envs
        self._size = config.run.num_envs // num_workers
        self._state: dict[str, Any] = {"env": parts.env.env_state()}
        self._collector: Any = None
        self._is_idle = False
        shares = [
            EnvShard(
                config,
                parts.agent.specs,
                first,
                self._size,
                # Other numbers than before where a run goes on.
                int(np.random.SeedSequence((config.run.seed, first, frames)).generate_state(1)[0]),
                packed(parts.agent.router) if config.run.low.freeze else None,
            )
            for first in range(0, self._num_envs, self._size)
        ]
        try:
            self._collector = self._start(shares, config)
        except BaseException:
            self.close()
            raise
        self._batches = iter(self._collector)
        self._thread = ThreadPoolExecutor(max_workers=1)
        self._is_idle = True

    @abstractmethod
    def _start(self, shares: Sequence[EnvShard], config: Config) -> Any:
        """Start a worker for each share, and return TorchRL's collector of them."""
        raise NotImplementedError

    def next(self) -> TensorDictBase:
        """Send the policy's state, then collect a batch; with `ahead`, hand out the one on its way and begin another.

        Raises:
            WorkerDiedError: a worker died.
        """
        self._is_idle = False
        policy = packed(self._policy)
        try:
            batch = self._collect(policy) if self._coming is None else self._coming.result()
        except Exception as error:
            # TorchRL ends the other workers by a signal that they block, and then complains of these.
            death = self._death()
            if death is None:
                raise
            raise WorkerDiedError(death) from error
        self._is_idle = True
        self._coming = None
        if self._ahead:
            batch = batch.clone()  # the workers write the next one to the same place
            self._coming = self._thread.submit(self._collect, policy)
        return batch.to(self._device)

    def _collect(self, policy: bytes) -> TensorDictBase:
        self.cpu_s = sum(self._call("policy.receive", policy))
        return self._joined(next(self._batches))

    def _joined(self, batch: TensorDictBase) -> TensorDictBase:
        """Return what TorchRL's collector gave as `[num_envs, steps_per_batch]`."""
        return batch

    def _death(self) -> str | None:
        """Return in words which worker has died and why, if one has."""
        return None

    def _call(self, method: str, *arguments: Any) -> list[Any]:
        """Return what a method of each worker's collector returns."""
        return self._collector.map_fn(method, [arguments] * self._collector.num_workers)

    def state(self) -> dict[str, Any]:
        """Return the workers' states side by side; if one failed, the last ones that are known.

        `generators` holds the state of each worker's random generator, `coming` the batch that is handed out next, if
        it has been collected.
        """
        is_known = self._is_idle and (self._coming is None or self._coming.exception() is None)
        if is_known:
            self._state = {"env": _side_by_side(self._call("env.env_state"))}
            if self._keeps_episodes:
                self._state["root"] = _side_by_side([_without_ids(root) for root in self._call("_carrier.to_dict")])
            self._state["generators"] = self._call("policy.generator_state")
            if self._coming is not None:
                self._state["coming"] = self._coming.result().clone().to_dict()
        return self._state

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state` of any collection; exploration is the same only with as many workers."""
        sizes = {len(column) for column in state["env"].values()}
        if sizes - {self._num_envs}:
            raise ValueError(f"the state is of {sizes.pop()} environments, but there are {self._num_envs}")
        self._state = dict(state)
        if state["env"]:  # else the episodes that the workers have just begun go on
            self._send("env.set_env_state", state["env"])
        if "root" in state and self._keeps_episodes:
            self._send("_carrier.update", state["root"])
        if "coming" in state:
            self._coming = Future()
            shape = state["coming"]["next"][keys.DONE].shape
            self._coming.set_result(TensorDict(state["coming"], batch_size=shape[:-1]))
        generators = state.get("generators", [])
        if len(generators) == self._collector.num_workers:
            self._collector.map_fn("policy.set_generator_state", [(generator,) for generator in generators])

    def _send(self, method: str, values: Mapping[str, Any]) -> None:
        """Call a method of each worker's collector with the worker's rows of nested values."""
        rows = [_sliced(values, first, self._size) for first in range(0, self._num_envs, self._size)]
        self._collector.map_fn(method, [(shard,) for shard in rows])

    def close(self) -> None:
        """End the workers."""
        if self._collector is not None:
            self._thread.shutdown()  # after the batch that is on its way
            self._collector.shutdown()
            self._collector = None


@contextmanager
def children_without(*numbers: signal.Signals) -> Iterator[None]:
    """Block these signals in all processes that are started within the block, and look for modules here last."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    protect_children()
    try:
        yield
    finally:
        unprotect_children()
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _side_by_side(states: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Concatenate the rows of nested columns."""
    columns: dict[str, Any] = {}
    for name, value in states[0].items():
        parts = [state[name] for state in states]
        columns[name] = _side_by_side(parts) if isinstance(value, Mapping) else torch.cat(parts)
    return columns


def _sliced(values: Mapping[str, Any], first: int, size: int) -> dict[str, Any]:
    """Return rows of nested columns, on the CPU."""
    return {
        name: _sliced(value, first, size) if isinstance(value, Mapping) else value[first : first + size].cpu()
        for name, value in values.items()
    }


def _without_ids(root: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out the trajectory numbers that TorchRL's collector keeps."""
    return {name: value for name, value in root.items() if name != "collector"}
