"""What a learner's networks see of an observation: the observation itself, or features of it."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.specs import PAMDPSpecs


class Perception(nn.Module):
    """Stands between a learner's observations and its networks, which are built from `specs` and see `forward`.

    Without further parts features are the observations themselves, and nothing is computed. The end of the features is
    the end of the observation, so that a shared learner's one-hot option stays in its place.

    An on-policy learner trains it with its whole loss. A learner with a replay buffer trains it with the critics' loss
    alone, and has a target copy beside the target critics; actors see detached features.

    Args:
        specs: of the problem, as the learner sees it.

    Attributes:
        specs: of the features; the networks behind are built from them.
        is_plain: whether features are the observations themselves.
        in_keys: what `see` reads of a step.
        out_keys: what `see` writes.
    """

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.specs = specs
        self.is_plain = True
        self.in_keys: list[NestedKey] = [keys.OBSERVATION]
        self.out_keys: list[NestedKey] = []

    def see(self, td: TensorDictBase) -> Tensor:
        """Return the features of a step `[*B]`, `[*B, specs.observation_dim]`, for the policy."""
        features: Tensor = self(td.get(keys.OBSERVATION))
        return features

    def forward(self, observation: Tensor) -> Tensor:
        """Return the features `[*B, specs.observation_dim]` of observations `[*B, *]`."""
        return observation
