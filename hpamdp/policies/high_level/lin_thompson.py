"""Thompson sampling for rewards that are linear in features of the observation.

Source: Agrawal and Goyal 2013, *Thompson Sampling for Contextual Bandits with Linear Payoffs*, arXiv 1209.3352,
algorithm 1.

Differs from the source:
- each option has a regression of its own;
- v is `exploration` times the standard deviation of all options' residuals. The source computes it from a bound of the
  noise, the number of features and a confidence;
- the predicted reward of each decision is sampled, instead of the parameters; its distribution is the same;
- untried options come first, in random order. The source scores them by the prior;
- decisions that are due at the same time use the same regressions, without the rewards that are not known yet;
- if the policy is greedy, it chooses the highest prediction, of an untried option only if all are untried.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hpamdp.policies.high_level.options import CARDS
from hpamdp.policies.shared.linear_bandit import LinearBandit


class LinThompson(LinearBandit):
    """Choose the option with the highest sample from the posterior distributions of the expected rewards.

    With `exploration=1` the samples are Bayesian.
    """

    card = CARDS["LinThompson"]

    def sample(self, mean: Tensor, deviation: Tensor) -> Tensor:
        """Return samples of the expected rewards."""
        return mean + self.options.exploration * deviation * torch.randn_like(mean)
