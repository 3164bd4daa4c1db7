"""A selector of one's own: a bandit that chooses by the softmax of the mean rewards."""

from __future__ import annotations

from pydantic import PositiveFloat
from torch import Tensor

from hpamdp.policies.shared.bandit import Bandit, BanditOptions


class SoftmaxOptions(BanditOptions):
    """Settings of `Softmax`."""

    temperature: PositiveFloat = 0.2
    """The higher it is, the more alike are the options' probabilities."""


class Softmax(Bandit):
    """Choose option i with probability exp(mean reward of i / temperature), normalised."""

    Options = SoftmaxOptions
    options: SoftmaxOptions

    def sample(self, num: int) -> Tensor:
        """Return `num` exploring choices, int64 `[num]`."""
        probabilities = (self.statistics.means / self.options.temperature).softmax(0)
        return probabilities.multinomial(num, replacement=True) if num else probabilities.new_zeros(0).long()
