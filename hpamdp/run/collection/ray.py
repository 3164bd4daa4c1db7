"""Collection in Ray actors, on this machine or on a cluster."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Sequence
from typing import ClassVar

from pydantic import PositiveInt
from tensordict import TensorDictBase
from torchrl.collectors.distributed import RayCollector

from hpamdp.config import Config
from hpamdp.run.assemble import Parts
from hpamdp.run.collection.worker import EnvShard
from hpamdp.run.collection.workers import WorkerCollection, children_without
from hpamdp.run.stopping import STOP_SIGNALS


class RayCollection(WorkerCollection):
    """Steps the environments in the actors of TorchRL's RayCollector."""

    package: ClassVar[str | None] = "ray"
    guarded_settings: ClassVar[tuple[str, ...]] = ("address",)

    def __init__(
        self,
        config: Config,
        parts: Parts,
        frames: int,
        *,
        num_workers: PositiveInt,
        ahead: bool,
        address: str | None = None,
    ) -> None:
        self.address = address
        super().__init__(config, parts, frames, num_workers, ahead=ahead)

    def _start(self, shares: Sequence[EnvShard], config: Config) -> RayCollector:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        # The learner waits for its actors, to which a local Ray would give niceness 15.
        os.environ.setdefault("RAY_worker_niceness", "0")
        # A local Ray has as many CPUs as it is told; with fewer than actors these would wait for ever.
        own = {"address": "local", "num_cpus": len(shares), "include_dashboard": False}
        init = own if self.address is None else {"address": self.address}
        # It misses weights to send; `receive` is there for them.
        for warning in ("RayCollector iteration started before weight", "The policy is not an nn.Module"):
            warnings.filterwarnings("ignore", message=warning)
        # Ray ends its own processes by SIGTERM.
        with children_without(*(number for number in STOP_SIGNALS if number != signal.SIGTERM)):
            return RayCollector(
                [share.make_env for share in shares],
                policy_factory=[share.make_policy for share in shares],
                frames_per_batch=config.run.num_envs * config.run.steps_per_batch,
                total_frames=sys.maxsize,  # it has no sign for endless
                device="cpu",
                ray_init_config={**init, "log_to_driver": False, "logging_level": "warning"},
                remote_configs={"num_cpus": 1},
                collector_kwargs={"auto_register_policy_transforms": False},
                weight_sync_schemes={},
                sync=True,
            )

    def _joined(self, batch: TensorDictBase) -> TensorDictBase:
        return batch.flatten(0, 1)
