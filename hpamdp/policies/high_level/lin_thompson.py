"""Thompson sampling for rewards that are linear in features of the observation.

Source: Agrawal and Goyal 2013, *Thompson Sampling for Contextual Bandits with Linear Payoffs*, arXiv 1209.3352,
algorithm 1.

Differs from the source:
- each option has a regression of its own;
- the standard deviation of the noise is that of the regressions' residuals;
- the predicted reward of each decision is sampled, instead of the parameters; its distribution is the same.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hpamdp.policies.shared.linear_bandit import LinearBandit


class LinThompson(LinearBandit):
    """Choose the option with the highest sample from the posterior distributions of the expected rewards.

    `exploration` is v in the source; 1 is Bayesian.
    """

    def sample(self, mean: Tensor, deviation: Tensor) -> Tensor:
        """Return samples of the expected rewards."""
        return mean + self.options.exploration * deviation * torch.randn_like(mean)
