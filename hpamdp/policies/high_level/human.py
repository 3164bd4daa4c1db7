"""The human choice of the option, as measured: a reference for selectors."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.policies.high_level.options import CARDS
from hpamdp.specs import PAMDPSpecs


class Human(Selector):
    """Choose each option with the probability that humans choose it in the same situation, greedy or not."""

    card = CARDS["Human"]

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.in_keys = [*self.in_keys, keys.HUMAN_OPTION]

    def select(self, td: TensorDictBase) -> Tensor:
        """Return samples, int64 `[*B]`, from the human probabilities `[*B, num_options]`."""
        probabilities = td.get(keys.HUMAN_OPTION)
        mask = td.get(keys.OPTION_MASK, None)
        probabilities = probabilities if mask is None else (probabilities + 1e-9) * mask
        return probabilities.flatten(0, -2).multinomial(1).reshape(probabilities.shape[:-1])
