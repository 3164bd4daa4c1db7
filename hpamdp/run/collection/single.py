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
from hpamdp.run.collection.base import Collection, check_state, random_seeds
from hpamdp.run.collection.options import CARDS


class SingleCollection(Collection):
    """Steps the environments in the learner's own process, between two updates."""

    card = CARDS["SingleCollection"]

    def __init__(self, config: Config, parts: AssembledRun, frames: int = 0) -> None:
        self._parts = parts
        self.env = parts.env
        # Of new episodes in a resumed run; the run's own seed would begin with its first episodes again.
        self._fresh_seed = None if frames == 0 else random_seeds(config.run.seed, 0, frames)[1]
        if self._fresh_seed is not None and not self.env.keeps_episodes:
            self.env.set_seed(self._fresh_seed, static_seed=True)
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
                track_traj_ids=False,  # numbers that nothing reads would take a third of a small step's time
            )
        if selector is not None and pending is not None:
            selector.pending.copy_(pending)  # TorchRL has just tried the policy, which made no real decisions
        self._batches = iter(self._collector)
        self._is_idle = True
        self._before: dict[str, Any] = {}  # the state before the batch that is being collected

    def next(self) -> TensorDictBase:
        """Collect a batch."""
        self._before = self.state()
        self._is_idle = False
        with acting(ExplorationType.RANDOM):
            batch = next(self._batches)
        self._is_idle = True
        return batch

    def state(self) -> dict[str, Any]:
        """Return the environments' state and the root of the next step.

        After an error in the middle of a batch it is the state before that batch, from which nothing was learned.
        """
        if not self._is_idle:
            return self._before
        state: dict[str, Any] = {"env": {name: column.clone() for name, column in self.env.env_state().items()}}
        if self.env.keeps_episodes:
            state["root"] = self._collector._carrier.clone().to_dict()
        return state

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`.

        Raises:
            ValueError: the state is of another run, for example with another number of environments.
        """
        check_state(state, self.env)
        if state["env"]:  # otherwise the collector continues the episodes that it has just begun
            self.env.set_env_state(state["env"])
            if not self.env.keeps_episodes:  # the saved statistics scale their first observations, too
                self._collector._carrier.update(self.env.reset())
        root = self._collector._carrier
        if "root" in state and self.env.keeps_episodes:
            root.update(TensorDict(state["root"], batch_size=root.batch_size))
        elif self.env.keeps_episodes and self._fresh_seed is not None:
            self.env.set_seed(self._fresh_seed, static_seed=True)
            root.update(self.env.reset())

    def close(self) -> None:
        """Stop collecting; the environment stays open."""
        self._collector.shutdown(close_env=False)
