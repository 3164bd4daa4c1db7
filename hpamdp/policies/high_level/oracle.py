"""The best option according to the environment's planner: a reference for selectors."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.policies.high_level.options import CARDS
from hpamdp.specs import PAMDPSpecs


class Oracle(Selector):
    """Choose the option whose best plan has the highest score."""

    card = CARDS["Oracle"]

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.in_keys = [*self.in_keys, keys.ORACLE_OPTION]

    def select(self, td: TensorDictBase) -> Tensor:
        """Return the planner's option for every environment, int64 `[*B]`."""
        return td.get(keys.ORACLE_OPTION)
