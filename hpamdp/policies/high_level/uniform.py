"""A uniformly random option at every decision: a reference for selectors."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.policies.masks import random_choice


class Uniform(Selector):
    """Choose each allowed option with the same probability."""

    takes_pictures = True

    def select(self, td: TensorDictBase) -> Tensor:
        """Return a random option for every environment, int64 `[*B]`."""
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        mask = td.get(keys.OPTION_MASK, None)
        return random_choice(is_decision.shape, self.specs.num_options, mask, is_decision.device)
