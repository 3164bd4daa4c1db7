"""LinUCB: upper confidence bounds on payoffs that are linear in features of the observation.

Source: Li, Chu, Langford and Schapire 2010, *A Contextual-Bandit Approach to Personalized News Article Recommendation*,
arXiv 1003.0146, algorithm 1 (disjoint models). Discounting: Russac, Vernade and Cappe 2019, arXiv 1909.09146.

Differs from the sources: the width is in units of the regression's residual deviation; the discounted form has one
Gram matrix.
"""

from __future__ import annotations

from torch import Tensor

from hpamdp.policies.shared.context import LinearBandit


class LinUCB(LinearBandit):
    """Choose the option with the highest prediction + exploration x its deviation.

    `exploration` is the factor of the width, alpha of the source.
    """

    def sample(self, mean: Tensor, deviation: Tensor) -> Tensor:
        """Return the upper bounds."""
        return mean + self.exploration * deviation
