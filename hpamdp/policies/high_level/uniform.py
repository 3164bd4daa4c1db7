"""A uniformly random option at every decision: a reference for selectors."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector


class Uniform(Selector):
    """Choose each option with the same probability."""

    def select(self, td: TensorDictBase) -> Tensor:
        """Return a random option for every environment, int64 `[*B]`."""
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        return torch.randint_like(is_decision, self.specs.num_options, dtype=torch.long)
