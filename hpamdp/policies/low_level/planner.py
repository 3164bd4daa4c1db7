"""The environment's own planner as a learner: the upper line."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from hpamdp import keys
from hpamdp.policies.base import Learner
from hpamdp.specs import PAMDPSpecs


class PlannerPolicy(TensorDictModuleBase):
    """Press what the best plan for the held option says."""

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.in_keys = [keys.ORACLE_DISCRETE, keys.ORACLE_PARAMETERS]
        if specs.num_options:
            self.in_keys.append(keys.OPTION)
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.specs = specs

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the action leaves; the plan's duration stands for every key, of which only the pressed one's counts."""
        discrete, duration = td.get(keys.ORACLE_DISCRETE), td.get(keys.ORACLE_PARAMETERS)
        option = td.get(keys.OPTION) if self.specs.num_options else torch.zeros_like(discrete[..., 0])
        discrete, duration = (plan.gather(-1, option.unsqueeze(-1)).squeeze(-1) for plan in (discrete, duration))
        duration = duration.unsqueeze(-1).expand(*duration.shape, self.specs.num_parameters)
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": duration}})


class Planner(Learner):
    """Learn nothing and follow the planner."""

    needs: ClassVar[tuple[str, ...]] = ("oracle",)

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.policy = PlannerPolicy(specs)
