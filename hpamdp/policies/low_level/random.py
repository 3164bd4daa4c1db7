"""Uniformly random actions: the lower reference for learners."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from hpamdp import keys
from hpamdp.policies.base import Learner
from hpamdp.policies.low_level.options import CARDS
from hpamdp.policies.masks import random_discrete
from hpamdp.specs import PAMDPSpecs


class RandomPolicy(TensorDictModuleBase):
    """Takes a uniformly random allowed discrete action with uniformly random parameters."""

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.specs = specs

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]` and the parameters `[*B, num_parameters]`."""
        device = td.get(keys.OBSERVATION).device
        unit_parameters = (
            2.0 * torch.rand(*td.batch_size, self.specs.num_parameters, device=device, dtype=torch.float32) - 1.0
        )
        allowed = self.specs.allowed(td.get(keys.OBSERVATION), td.get(keys.ACTION_MASK, None))
        discrete = random_discrete(self.specs, td.batch_size, allowed, device, td.get(keys.PAIR_MASK, None))
        parameters = self.specs.from_unit(unit_parameters, td)
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": parameters}})


class Random(Learner):
    """Acts at random and learns nothing."""

    card = CARDS["Random"]

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.policy = RandomPolicy(specs)
