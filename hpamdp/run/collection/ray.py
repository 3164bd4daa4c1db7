"""Collect batches in Ray actors, on this machine or on a cluster."""

from __future__ import annotations

import os
import re
import signal
import sys
import warnings
from pathlib import Path
from typing import Any, NoReturn

from torchrl.collectors.distributed import RayCollector

from hpamdp.children import STOP_SIGNALS, children_without
from hpamdp.config.schema import Config
from hpamdp.messages import first_line, one_line, warn
from hpamdp.run.assemble import AssembledRun
from hpamdp.run.collection.base import CollectionError
from hpamdp.run.collection.options import CARDS, RayOptions
from hpamdp.run.collection.worker import EnvShard, ShardCollector
from hpamdp.run.collection.workers import WorkerCollection


class RayCollection(WorkerCollection):
    """Steps the environments in the actors of TorchRL's RayCollector."""

    Options = RayOptions
    card = CARDS["RayCollection"]

    def __init__(
        self, config: Config, parts: AssembledRun, frames: int, options: RayOptions | None = None, **settings: Any
    ) -> None:
        options = RayOptions.of(options, settings)
        # RayCollector warns that it sends no weights, since `collect` sends them instead.
        for warning in ("RayCollector iteration started before weight", "The policy is not an nn.Module"):
            warnings.filterwarnings("ignore", message=warning)
        _connect(options.address, options.num_workers)
        super().__init__(config, parts, frames, options)

    def _start(self, shard: EnvShard) -> RayCollector:
        return RayCollector(
            [shard.make_env],
            policy_factory=[shard.make_policy],
            frames_per_batch=shard.num_envs * self._config.run.steps_per_batch,
            total_frames=sys.maxsize,  # RayCollector cannot collect without an end
            device="cpu",
            remote_configs={"num_cpus": 1},
            collector_class=ShardCollector,
            collector_kwargs={"auto_register_policy_transforms": False},
            weight_sync_schemes={},
            sync=True,
        )

    def kill(self, worker: RayCollector) -> None:
        """End a worker at once."""
        import ray

        ray.kill(worker.remote_collectors[0])

    def _raise_explained(self, number: int, error: Exception) -> NoReturn:
        from ray.exceptions import RayTaskError

        # Ray wraps an actor's error into another one, whose text is a traceback.
        super()._raise_explained(number, error.cause if isinstance(error, RayTaskError) else error)

    def _death(self, worker: RayCollector | None, error: Exception) -> str | None:
        from ray.exceptions import RayActorError

        if not isinstance(error, RayActorError):
            return None
        text = str(error)
        if error.actor_init_failed:
            return f"as it started: {one_line(text.strip().splitlines()[-1])}"
        node = re.search(r"^\s*ip: (\S+)$", text, re.MULTILINE)
        why = re.search(r"(?:is dead because|died because) (.*?)\.(?:\s|$)", text)
        where = f"on {node.group(1)}" if node else "on an unknown node"
        return f"{where}: {one_line(why.group(1))}" if why else f"{where}: {first_line(text)}"

    def close(self) -> None:
        """End the actors, and Ray itself if it was started for the run."""
        import ray

        try:
            super().close()
        finally:
            ray.shutdown()


def _connect(address: str | None, num_workers: int) -> None:
    """Start Ray on this machine for the time of the run, or connect to a running cluster.

    Raises:
        CollectionError: Ray does not start, or the cluster does not answer.
    """
    # Ray reads this as it is imported. Otherwise a thread that still waits for an actor starts another Ray.
    os.environ.setdefault("RAY_ENABLE_AUTO_CONNECT", "0")
    import ray

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # The learner waits for its actors, to which a local Ray would give niceness 15.
    os.environ.setdefault("RAY_worker_niceness", "0")
    # Its C++ part prints a line a second while it waits for a cluster.
    os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "error")
    # A local Ray takes `num_cpus` as given; with fewer CPUs than actors some actors would wait forever.
    init: dict[str, Any] = {"address": "local", "num_cpus": num_workers, "include_dashboard": False}
    if address is not None:
        init = {"address": address}
    on_sigterm = signal.getsignal(signal.SIGTERM)  # which Ray replaces
    working_dir = os.getcwd()
    try:
        # Ray lets its workers look for modules in the working directory first, so leave it.
        os.chdir(Path(__file__).parents[3])
        # Ray ends its own processes by SIGTERM.
        with children_without(*(number for number in STOP_SIGNALS if number != signal.SIGTERM)):
            ray.init(**init, log_to_driver=False, logging_level="warning")
    except Exception as error:  # Ray raises many classes of errors
        what = "does not start" if address is None else "does not answer"
        raise CollectionError(f"{_named(address)}: Ray {what} ({first_line(error)})") from error
    finally:
        os.chdir(working_dir)
        if signal.getsignal(signal.SIGTERM) is not on_sigterm:
            signal.signal(signal.SIGTERM, on_sigterm)
    num_cpus = int(ray.cluster_resources().get("CPU", 0))
    if num_cpus < num_workers:
        warn(f"collector.num_workers={num_workers}: the cluster has {num_cpus} CPUs; the run waits until more join it")


def _named(address: str | None) -> str:
    return "collector=ray" if address is None else f"collector.address={address}"
