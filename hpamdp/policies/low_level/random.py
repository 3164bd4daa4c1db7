"""Uniformly random actions: the lower reference for learners."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from hpamdp import keys
from hpamdp.policies.base import Learner
from hpamdp.policies.low_level.options import CARDS
from hpamdp.policies.masks import random_action
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
        return random_action(self.specs, td)


class Random(Learner):
    """Acts at random and learns nothing."""

    card = CARDS["Random"]

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.policy = RandomPolicy(specs)
