"""What a selector remembers of the decisions of an episode.

A selector is the policy of a semi-MDP, whose steps are decisions. So its history is made of the observations at its
decisions. What was observed within options is not part of it.
"""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.policies.shared.memory import MemoryOptions, ReplayMemoryOptions, StackOptions
from hpamdp.policies.shared.perception import Perception

# Before the name of the state in a step, where learners have memories of their own.
_PREFIX = "option_"


class SelectorStackOptions(StackOptions):
    """Settings of a selector's memory of the last decisions."""

    memory: Literal["none", "stack"] = "none"
    """What the networks see beside the observation: nothing, or the observations at the episode's earlier decisions."""


class SelectorMemoryOptions(MemoryOptions):
    """Settings of a selector's memory."""

    memory: Literal["none", "stack", "gru"] = "none"
    """What the networks see beside the observation: nothing, those at earlier decisions, or a GRU's state of them."""


class SelectorReplayMemoryOptions(ReplayMemoryOptions, SelectorMemoryOptions):
    """Settings of a selector's memory that learns from a replay buffer."""


class RemembersDecisions(Selector):
    """Base class for selectors whose networks see a `Perception` of the observations at the decisions so far.

    A subclass calls `set_perception` in its constructor, and its networks see `seen`. A memory goes on at decisions
    alone, since `forward` holds what `choose` returns until the next one.

    Attributes:
        perception: what the networks see of an observation.
    """

    perception: Perception

    def set_perception(self, options: StackOptions) -> None:
        """Make the perception; call it before the networks, which are built from its specs."""
        self.perception = Perception(self.specs, options, _PREFIX)
        self.memory_key = self.perception.memory_key
        if self.memory_key is not None:
            self.in_keys += [key for key in self.perception.in_keys if key not in self.in_keys]
            self.out_keys += [self.memory_key]
            self.export_refusal = f"remembers {self.memory_key}"

    def choose(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return the option of `select`, and the state of the memory."""
        return {**super().choose(td), **self.remembered(td)}

    def choose_uniformly(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return a uniformly random option, and the state of the memory."""
        return {**super().choose_uniformly(td), **self.remembered(td)}

    def seen(self, td: TensorDictBase) -> Tensor:
        """Return what the networks see of a step `[*B]`, as at a decision, `[*B, perception.specs.observation_dim]`."""
        features, _ = self.perception.look(td)
        return features

    @torch.no_grad()
    def remembered(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return the memory's state after a decision at a step `[*B]`, under its key; empty without memory."""
        _, states = self.perception.look(td)
        return states

    def held(self, batch: TensorDictBase) -> Tensor | None:
        """Return the memory's states after the last decisions, `[*B, size]`; None without memory."""
        return None if self.memory_key is None else batch.get(self.memory_key)

    @property
    def stores_features(self) -> bool:
        """Whether stored states are what the networks see: those of a memory that does not learn."""
        return self.perception.memory is not None and not self.perception.is_recurrent

    def stored_state(self, decisions: TensorDictBase) -> Tensor:
        """Return what is stored of the observations at finished decisions `[*B]`: these, or features of them."""
        observation: Tensor = decisions.get(("next", keys.DECISION_OBSERVATION))
        if not self.stores_features:
            return observation
        features: Tensor = self.perception(observation, self.held(decisions), has_seen=True)
        return features

    def of_stored(self, state: Tensor) -> Tensor:
        """Return what the networks see of stored states, `[N, perception.specs.observation_dim]`; not if recurrent."""
        return state if self.stores_features else self.perception(state)

    @staticmethod
    def begins(decisions: TensorDictBase) -> Tensor:
        """Return whether finished decisions were the first of their episodes, bool `[*B]`."""
        after = decisions.get("next")
        return (after.get(keys.EPISODE_STEPS) == after.get(keys.OPTION_STEPS)).squeeze(-1)
