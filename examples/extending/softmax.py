"""A selector of one's own: a bandit that chooses by the softmax of the mean rewards."""

from __future__ import annotations

from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from hpamdp.policies.shared.bandit import Bandit, Discount, Memory
from hpamdp.specs import PAMDPSpecs


class Softmax(Bandit):
    """Choose option i with probability exp(mean reward of i / temperature), normalised."""

    def __init__(
        self,
        specs: PAMDPSpecs,
        *,
        temperature: PositiveFloat,
        memory: Memory,
        discount: Discount,
        window: PositiveInt,
    ) -> None:
        super().__init__(specs, memory, discount, window)
        self.temperature = temperature

    def sample(self, num: int) -> Tensor:
        """Return `num` exploring choices, int64 `[num]`."""
        probabilities = (self.statistics.means / self.temperature).softmax(0)
        return probabilities.multinomial(num, replacement=True) if num else probabilities.new_zeros(0).long()
