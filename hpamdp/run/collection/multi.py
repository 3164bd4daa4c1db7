"""Collection in worker processes on this machine."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from multiprocessing import connection, resource_tracker

from pydantic import PositiveInt
from torchrl.collectors import MultiSyncCollector

from hpamdp.config import Config
from hpamdp.run.assemble import Parts
from hpamdp.run.collection.worker import EnvShard
from hpamdp.run.collection.workers import WorkerCollection, children_without
from hpamdp.run.stopping import STOP_SIGNALS

_PATIENCE_S = 2.0  # from the moment a worker's pipe is closed until it has an exit code


class MultiCollection(WorkerCollection):
    """Steps the environments in processes of TorchRL's MultiSyncCollector, which write into shared memory."""

    def __init__(self, config: Config, parts: Parts, frames: int, *, num_workers: PositiveInt, ahead: bool) -> None:
        super().__init__(config, parts, frames, num_workers, ahead=ahead)

    def _death(self) -> str | None:
        workers = self._collector.procs
        ended = connection.wait([worker.sentinel for worker in workers if not worker._closed], _PATIENCE_S)
        for i, worker in enumerate(workers):
            if worker._closed or worker.sentinel not in ended:
                continue
            worker.join(_PATIENCE_S)  # its files are closed before it has an exit code
            code = worker.exitcode
            if code is None:
                continue
            why = f"exit code {code}" if code >= 0 else f"signal {-code}, {signal.Signals(-code).name}"
            return f"collector=multi: worker {i} of {len(workers)} died ({why})"
        return None

    def _start(self, shares: Sequence[EnvShard], config: Config) -> MultiSyncCollector:
        # multiprocessing unblocks the signals when it starts this helper of its own.
        resource_tracker.ensure_running()
        # A terminal sends its Ctrl-C, and a cluster its stop, to every process of a run.
        with children_without(*STOP_SIGNALS):
            return MultiSyncCollector(
                [share.make_env for share in shares],
                policy_factory=[share.make_policy for share in shares],
                frames_per_batch=config.run.num_envs * config.run.steps_per_batch,
                total_frames=-1,
                device="cpu",
                num_threads=config.run.threads,
                cat_results=0,
                use_buffers=True,
                auto_register_policy_transforms=False,
            )
