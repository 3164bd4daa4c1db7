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
        self.in_keys = [keys.ORACLE_KEY, keys.ORACLE_DURATION]
        if specs.num_options:
            self.in_keys.append(keys.OPTION)
        self.out_keys = [keys.KEY, keys.DURATION]
        self.specs = specs

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the action leaves; the plan's duration stands for every key, of which only the pressed one's counts."""
        key, duration = td.get(keys.ORACLE_KEY), td.get(keys.ORACLE_DURATION)
        option = td.get(keys.OPTION) if self.specs.num_options else torch.zeros_like(key[..., 0])
        key, duration = (plan.gather(-1, option.unsqueeze(-1)).squeeze(-1) for plan in (key, duration))
        duration = duration.unsqueeze(-1).expand(*duration.shape, self.specs.num_parameters)
        return td.update({keys.ACTION: {"key": key, "duration": duration}})


class Planner(Learner):
    """Learn nothing and follow the planner."""

    needs: ClassVar[tuple[str, ...]] = ("oracle",)

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.policy = PlannerPolicy(specs)
