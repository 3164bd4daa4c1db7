"""The environment's own planner as a learner: the upper reference for learners."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from hpamdp import keys
from hpamdp.policies.base import Learner
from hpamdp.policies.low_level.options import CARDS
from hpamdp.specs import PAMDPSpecs


class PlannerPolicy(TensorDictModuleBase):
    """Takes the planned action of the current option."""

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        in_keys: list[NestedKey] = [keys.ORACLE_DISCRETE, keys.ORACLE_PARAMETERS]
        if specs.num_options:
            in_keys.append(keys.OPTION)
        self.in_keys = in_keys
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.specs = specs

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]` and the parameters `[*B, num_parameters]`.

        A plan has one parameter, which is written for every discrete action; only the planned action's own counts.
        """
        # One plan for each option, `[*B, num_options]`; a single one if the problem has no options.
        planned_discrete = td.get(keys.ORACLE_DISCRETE)
        planned_parameter = td.get(keys.ORACLE_PARAMETERS)
        option = td.get(keys.OPTION) if self.specs.num_options else torch.zeros_like(planned_discrete[..., 0])
        option = option.unsqueeze(-1)
        discrete = planned_discrete.gather(-1, option).squeeze(-1)
        parameter = planned_parameter.gather(-1, option)
        parameters = parameter.expand(*parameter.shape[:-1], self.specs.num_parameters)
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": parameters}})


class Planner(Learner):
    """Follows the planner and learns nothing."""

    card = CARDS["Planner"]

    export_refusal = "plans at every step"

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.policy = PlannerPolicy(specs)
