"""Define a custom selector: a bandit that chooses by the softmax of the mean rewards."""

from __future__ import annotations

from pydantic import PositiveFloat
from torch import Tensor

from hpamdp.policies.masks import masked_logits
from hpamdp.policies.shared.bandit import Bandit
from hpamdp.policies.shared.bandit_options import BanditOptions


class SoftmaxOptions(BanditOptions):
    """Settings of `Softmax`."""

    temperature: PositiveFloat = 0.2
    """Temperature of the softmax. A higher one makes the options' probabilities more equal."""


class Softmax(Bandit):
    """Choose option i with a probability proportional to exp(mean reward of i / temperature)."""

    Options = SoftmaxOptions
    options: SoftmaxOptions

    def sample(self, num: int, allowed: Tensor | None = None) -> Tensor:
        """Return `num` exploratory choices, int64 `[num]`, of the allowed options."""
        probabilities = masked_logits(self.statistics.means / self.options.temperature, allowed).softmax(0)
        return probabilities.multinomial(num, replacement=True) if num else probabilities.new_zeros(0).long()
