"""Random presses: the lower line for learners."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from hpamdp import keys
from hpamdp.policies.base import Learner
from hpamdp.specs import PAMDPSpecs


class RandomPolicy(TensorDictModuleBase):
    """Press a uniformly random key with uniformly random parameters."""

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.specs = specs

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the action leaves."""
        batch, device = td.batch_size, td.get(keys.OBSERVATION).device
        unit = 2.0 * torch.rand(*batch, self.specs.num_parameters, device=device) - 1.0
        discrete = torch.randint(self.specs.num_discrete, batch, device=device)
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": self.specs.from_unit(unit)}})


class Random(Learner):
    """Learn nothing and press at random."""

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.policy = RandomPolicy(specs)
