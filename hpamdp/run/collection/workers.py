"""What collections in several processes share."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp.config import Config
from hpamdp.run.assemble import Parts
from hpamdp.run.collection.base import Collection
from hpamdp.run.collection.worker import EnvShard, packed


class WorkerCollection(Collection):
    """Steps an equal shard of the environments in each of `num_workers` processes, on the CPU with one thread.

    Environment `i` has the same episodes as in a single process; only exploration uses other random numbers, one
    stream for each worker. Before each batch, all workers get the policy's weights and buffers; they wait for one
    another and for the learner. A subclass starts TorchRL's collector in `_start`.
    """

    has_workers: ClassVar[bool] = True

    def __init__(self, config: Config, parts: Parts, frames: int, num_workers: int) -> None:
        self._policy = parts.policy
        self._device = parts.device
        self._columns = parts.env.env_state()
        self._collector: Any = None
        self._is_idle = False
        size = config.run.num_envs // num_workers
        shares = [
            EnvShard(
                config,
                parts.agent.specs,
                first,
                size,
                # Other numbers than before where a run goes on.
                int(np.random.SeedSequence((config.run.seed, first, frames)).generate_state(1)[0]),
                {name: column[first : first + size].cpu() for name, column in self._columns.items()},
                packed(parts.agent.router) if config.run.low.freeze else None,
            )
            for first in range(0, config.run.num_envs, size)
        ]
        try:
            with uninterrupted():
                self._collector = self._start(shares, config)
        except BaseException:
            self.close()
            raise
        self._batches = iter(self._collector)
        self._is_idle = True

    def _start(self, shares: Sequence[EnvShard], config: Config) -> Any:
        """Start a worker for each share, and return TorchRL's collector of them."""
        raise NotImplementedError

    def next(self) -> TensorDictBase:
        """Send the policy's state, then collect a batch; a Ctrl-C takes effect when it is there."""
        with uninterrupted():
            self._is_idle = False
            self.cpu_s = sum(self._call("policy.receive", packed(self._policy)))
            batch = self._joined(next(self._batches))
            self._is_idle = True
        return batch.to(self._device)

    def _joined(self, batch: TensorDictBase) -> TensorDictBase:
        """Return what TorchRL's collector gave as `[num_envs, steps_per_batch]`."""
        return batch

    def _call(self, method: str, *arguments: Any) -> list[Any]:
        """Return what a method of each worker's collector returns."""
        return self._collector.map_fn(method, [arguments] * self._collector.num_workers)

    def env_state(self) -> dict[str, Tensor]:
        """Return the environments' state; if a worker failed, the last one that is known."""
        if self._is_idle:
            with uninterrupted():
                columns = self._call("env.env_state")
                self._columns = {name: torch.cat([share[name] for share in columns]) for name in columns[0]}
        return self._columns

    def close(self) -> None:
        """End the workers."""
        if self._collector is not None:
            self._collector.shutdown()
            self._collector = None


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay a Ctrl-C to the end of the block: half a message would confuse the workers. A second one interrupts."""
    is_asked = False

    def note(*_: Any) -> None:
        nonlocal is_asked
        if is_asked:
            raise KeyboardInterrupt
        is_asked = True

    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in handlers.items() if handler != signal.SIG_IGN}
    for number in handlers:
        signal.signal(number, note)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    if is_asked:
        raise KeyboardInterrupt


@contextmanager
def children_without(*numbers: signal.Signals) -> Iterator[None]:
    """Block these signals in all processes that are started within the block."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
