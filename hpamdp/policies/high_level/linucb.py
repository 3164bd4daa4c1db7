"""LinUCB: upper confidence bounds on rewards that are linear in features of the observation.

Source: Li, Chu, Langford and Schapire 2010, *A Contextual-Bandit Approach to Personalized News Article Recommendation*,
arXiv 1003.0146, algorithm 1 (disjoint models). Discounting: Russac, Vernade and Cappe 2019, *Weighted Linear Bandits
for Non-Stationary Environments*, arXiv 1909.09146.

Differs from the sources:
- the width is in units of the standard deviation of all options' residuals;
- the discounted form has one Gram matrix for each option, not two;
- untried options come first, in random order. Li et al. score them by the prior;
- decisions that are due at the same time use the same regressions, without the rewards that are not known yet;
- if the policy is greedy, it chooses the highest prediction, of an untried option only if all are untried.
"""

from __future__ import annotations

from torch import Tensor

from hpamdp.policies.high_level.options import CARDS, LinUCBOptions
from hpamdp.policies.shared.linear_bandit import LinearBandit


class LinUCB(LinearBandit):
    """Choose the option with the highest expected reward + exploration x its standard deviation."""

    Options = LinUCBOptions
    card = CARDS["LinUCB"]

    def sample(self, mean: Tensor, deviation: Tensor) -> Tensor:
        """Return the upper confidence bounds."""
        return mean + self.options.exploration * deviation
