"""A uniformly random option at every decision: a reference for selectors."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.policies.high_level.options import CARDS
from hpamdp.policies.masks import random_choice


class Uniform(Selector):
    """Choose each allowed option with the same probability."""

    card = CARDS["Uniform"]

    def select(self, td: TensorDictBase) -> Tensor:
        """Return a random option for every environment, int64 `[*B]`."""
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        mask = td.get(keys.OPTION_MASK, None)
        return random_choice(is_decision.shape, self.specs.num_options, mask, is_decision.device)

    def option_probabilities(self, td: TensorDictBase) -> Tensor:
        """Return the probabilities of the options, `[*B, num_options]`: the same for all allowed ones."""
        mask = td.get(keys.OPTION_MASK, None)
        if mask is None:
            mask = torch.ones(*td.batch_size, self.specs.num_options, dtype=torch.bool, device=self.practice.device)
        return mask / mask.sum(-1, keepdim=True)
