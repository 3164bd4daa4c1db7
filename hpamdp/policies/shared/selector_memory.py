"""What a selector remembers of the decisions of an episode.

A selector is the policy of a semi-MDP, whose steps are decisions. So its history is made of the observations at its
decisions. What was observed within options is not part of it.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.policies.shared.options import StackOptions
from hpamdp.policies.shared.perception import Perception

# Before the name of the state in a step, where learners have memories of their own.
_PREFIX = "option_"


class RemembersDecisions(Selector):
    """Base class for selectors whose networks see a `Perception` of the observations at the decisions so far.

    A subclass calls `set_perception` in its constructor, and its networks see `seen`. The memory changes only at
    decisions: between them, `forward` holds what `held_with` returned.

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

    def seen(self, td: TensorDictBase) -> Tensor:
        """Return what the networks see of a decision in a step `[*B]`, `[*B, perception.specs.observation_dim]`."""
        features, _ = self.perception.features_and_memory(td)
        return features

    @torch.no_grad()
    def held_with(self, td: TensorDictBase, option: Tensor) -> dict[str, Tensor]:
        """Return the memory's state after a decision in a step `[*B]`, under its key; empty without a memory."""
        _, states = self.perception.features_and_memory(td)
        return states

    def held(self, batch: TensorDictBase) -> Tensor | None:
        """Return the memory's states after the last decisions, `[*B, size]`; None without a memory."""
        return None if self.memory_key is None else batch.get(self.memory_key)

    @staticmethod
    def begins(decisions: TensorDictBase) -> Tensor:
        """Return whether finished decisions were the first of their episodes, bool `[*B]`."""
        after = decisions.get("next")
        return (after.get(keys.EPISODE_STEPS) == after.get(keys.OPTION_STEPS)).squeeze(-1)
