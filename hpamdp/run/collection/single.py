"""Collection in the learner's own process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDictBase
from torchrl.collectors import Collector

from hpamdp.config import Config
from hpamdp.run.assemble import Parts
from hpamdp.run.collection.base import Collection
from hpamdp.run.collection.root import collector_state, set_collector_state


class SingleCollection(Collection):
    """Steps the environments in the learner's own process, between two updates."""

    def __init__(self, config: Config, parts: Parts) -> None:
        self.env = parts.env
        selector = parts.agent.selector
        pending = None if selector is None else selector.pending.clone()
        self._collector = Collector(
            parts.env,
            parts.policy,
            frames_per_batch=config.run.num_envs * config.run.steps_per_batch,
            total_frames=-1,
            auto_register_policy_transforms=False,
        )
        if selector is not None and pending is not None:
            selector.pending.copy_(pending)  # TorchRL has just tried the policy: those were no decisions
        self._batches = iter(self._collector)
        self._is_idle = True

    def next(self) -> TensorDictBase:
        """Collect a batch."""
        self._is_idle = False
        batch = next(self._batches)
        self._is_idle = True
        return batch

    def state(self) -> dict[str, Any]:
        """Return the environments' state and the root of the next step.

        After an error in the middle of a batch, when TorchRL has closed its collector, there are no episodes to go on
        with; what else the environments' state holds, such as the scale of observations, is returned.
        """
        if self._is_idle:
            return collector_state(self._collector)
        return {"env": {} if self.env.keeps_episodes else self.env.env_state()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`."""
        set_collector_state(self._collector, state)

    def close(self) -> None:
        """Stop collecting; the environment stays open."""
        self._collector.shutdown(close_env=False)
