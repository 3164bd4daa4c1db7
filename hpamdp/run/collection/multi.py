"""Collect batches in worker processes on this machine."""

from __future__ import annotations

import os
import signal
import time
from multiprocessing import connection, resource_tracker
from typing import Any

from torchrl.collectors import MultiSyncCollector

from hpamdp.children import STOP_SIGNALS, children_protected, children_without, how_it_ended
from hpamdp.config.schema import Config
from hpamdp.limits import SHARED_MEMORY
from hpamdp.messages import warn
from hpamdp.run.assemble import AssembledRun
from hpamdp.run.collection.options import CARDS, WorkerOptions
from hpamdp.run.collection.worker import EnvShard, SharedMemoryCollector
from hpamdp.run.collection.workers import WorkerCollection

_PATIENCE_S = 2.0  # from the moment a worker's pipe is closed until it has an exit code


class MultiCollection(WorkerCollection):
    """Steps the environments in processes of TorchRL's MultiSyncCollector, which write into shared memory."""

    card = CARDS["MultiCollection"]

    def __init__(
        self, config: Config, parts: AssembledRun, frames: int, options: WorkerOptions | None = None, **settings: Any
    ) -> None:
        options = WorkerOptions.of(options, settings)
        num, num_cpus = options.num_workers, len(os.sched_getaffinity(0))
        if num > num_cpus:
            warn(f"collector.num_workers={num}: more than the {num_cpus} CPUs, which the workers will share")
        # multiprocessing unblocks the signals when it starts this helper of its own.
        with children_protected():
            resource_tracker.ensure_running()
        self._starting: list[_Worker] = []
        super().__init__(config, parts, frames, options)

    def _start(self, shard: EnvShard) -> MultiSyncCollector:
        # A terminal sends Ctrl-C, and a cluster its stop signal, to every process of a run.
        with children_without(*STOP_SIGNALS):
            return _Worker(
                self._starting,
                [shard.make_env],
                policy_factory=[shard.make_policy],
                frames_per_batch=shard.num_envs * self._config.run.steps_per_batch,
                total_frames=-1,
                device="cpu",
                num_threads=self._config.run.threads,
                collector_class=SharedMemoryCollector,
                use_buffers=True,
                auto_register_policy_transforms=False,
            )

    def kill(self, worker: MultiSyncCollector) -> None:
        """End a worker at once."""
        worker.procs[0].kill()

    def _death(self, worker: MultiSyncCollector | None, error: Exception) -> str | None:
        if worker is None:
            return "as it started" if isinstance(error.__cause__, EOFError) else None
        process = worker.procs[0]
        if not connection.wait([process.sentinel], _PATIENCE_S):
            return None
        process.join(_PATIENCE_S)  # its files are closed before it has an exit code
        code = process.exitcode
        if code is None:
            return None
        return how_it_ended(code) + (f": {SHARED_MEMORY}" if code == -signal.SIGBUS else "")

    def close(self) -> None:
        """End the workers. Kill those still starting, or the end of the run's process would wait for them."""
        super().close()
        while self._starting:
            for worker in [*self._starting]:
                for process in getattr(worker, "procs", ()):
                    process.kill()
            time.sleep(0.05)  # until the threads that start them have an error
        self._in_parallel(self._end)  # of workers that have started meanwhile


class _Worker(MultiSyncCollector):
    """TorchRL's collector, listed while it starts, so that `close` can kill its process."""

    def __init__(self, starting: list[_Worker], *args: Any, **settings: Any) -> None:
        starting.append(self)
        try:
            super().__init__(*args, **settings)
        finally:
            starting.remove(self)
