"""People's choice of the option, as measured: a reference for selectors."""

from __future__ import annotations

from typing import ClassVar

from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.specs import PAMDPSpecs


class Human(Selector):
    """Choose each option as often as people do in the same situation, also where the policy is greedy."""

    needs: ClassVar[tuple[str, ...]] = ("human",)

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.in_keys = [*self.in_keys, keys.HUMAN_OPTION]

    def select(self, td: TensorDictBase) -> Tensor:
        """Return draws `[*B]` from people's shares `[*B, num_options]`."""
        shares = td.get(keys.HUMAN_OPTION)
        return shares.flatten(0, -2).multinomial(1).reshape(shares.shape[:-1])
