"""Thompson sampling: choose each option with the probability that it is the best one.

Source: Russo, Van Roy, Kazerouni, Osband and Wen 2018, *A Tutorial on Thompson Sampling*, arXiv 1707.02038, section 3.
Forgetting: see `RewardStatistics`.

Differs from the source: the variance of the rewards is the observed one; the prior of the means is flat.
"""

from __future__ import annotations

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from hpamdp.policies.masks import masked_values
from hpamdp.policies.shared.bandit import Bandit, Discount, Memory
from hpamdp.specs import PAMDPSpecs


class Thompson(Bandit):
    """Choose the option with the highest sample from the Gaussian posterior distributions of the mean rewards.

    Args:
        specs: of the problem.
        exploration: factor of the posteriors' standard deviation; 1 is Bayesian.
        memory, discount, window: which rewards count, as in `RewardStatistics`.
    """

    def __init__(
        self,
        specs: PAMDPSpecs,
        *,
        exploration: PositiveFloat,
        memory: Memory,
        discount: Discount,
        window: PositiveInt,
    ) -> None:
        super().__init__(specs, memory, discount, window)
        self.exploration = exploration

    def sample(self, num: int, allowed: Tensor | None = None) -> Tensor:
        """Return `num` choices, each from samples of its own."""
        statistics = self.statistics
        noise = torch.randn(num, self.specs.num_options, dtype=torch.float64, device=statistics.counts.device)
        deviation = self.exploration * statistics.deviation / statistics.counts.clamp(min=1e-9).sqrt()
        sampled_means = statistics.means + deviation * noise
        # Untried options come first, in random order.
        return masked_values(torch.where(statistics.is_untried, 1e9 + noise, sampled_means), allowed).argmax(-1)
