"""Collect batches in the learner's own process.

TorchRL resets all environments when a collector is built, and its `Collector.state_dict` holds only the policy and the
environment's modules. So this module saves and restores a collector's root, the tensordict from which it makes the next
step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from hpamdp.acting import acting
from hpamdp.config.schema import Config
from hpamdp.run.assemble import AssembledRun
from hpamdp.run.collection.base import Collection, checked_state, random_seeds


class SingleCollection(Collection):
    """Steps the environments in the learner's own process, between two updates."""

    def __init__(self, config: Config, parts: AssembledRun, frames: int = 0) -> None:
        self._parts = parts
        self.env = parts.env
        if frames > 0 and not self.env.keeps_episodes:  # otherwise the run's first episodes would come again
            self.env.set_seed(random_seeds(config.run.seed, 0, frames)[1], static_seed=True)
        selector = parts.agent.selector
        pending = None if selector is None else selector.pending.clone()
        with acting(ExplorationType.RANDOM):
            self._collector = Collector(
                parts.env,
                parts.policy,
                frames_per_batch=config.run.num_envs * config.run.steps_per_batch,
                total_frames=-1,
                # Otherwise TorchRL casts the whole tensordict twice at every step.
                device=parts.device,
                trust_policy=True,
                auto_register_policy_transforms=False,
            )
        if selector is not None and pending is not None:
            selector.pending.copy_(pending)  # TorchRL has just tried the policy, which made no real decisions
        self._batches = iter(self._collector)
        self._is_idle = True

    def next(self) -> TensorDictBase:
        """Collect a batch."""
        self._is_idle = False
        with acting(ExplorationType.RANDOM):
            batch = next(self._batches)
        self._is_idle = True
        return batch

    def state(self) -> dict[str, Any]:
        """Return the environments' state and the root of the next step.

        An error in the middle of a batch closes TorchRL's collector, so there are no episodes to continue. Then the
        state holds only the rest, such as the scale of observations.
        """
        if not self._is_idle:
            return {"env": {} if self.env.keeps_episodes else self.env.env_state()}
        state: dict[str, Any] = {"env": {name: column.clone() for name, column in self.env.env_state().items()}}
        if self.env.keeps_episodes:
            state["root"] = self._collector._carrier.exclude("collector").clone().to_dict()
        return state

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`.

        Raises:
            ValueError: the state is of another run, for example with another number of environments.
        """
        saved = checked_state(state, self._parts)
        if saved.env:  # otherwise the collector continues the episodes that it has just begun
            self.env.set_env_state(saved.env)
            if not self.env.keeps_episodes:  # the saved statistics scale their first observations, too
                self._collector._carrier.update(self.env.reset())
        if saved.root is not None and self.env.keeps_episodes:
            root = self._collector._carrier
            root.update(TensorDict(saved.root, batch_size=root.batch_size))

    def close(self) -> None:
        """Stop collecting; the environment stays open."""
        self._collector.shutdown(close_env=False)
