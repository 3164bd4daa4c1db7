"""Thompson sampling for payoffs that are linear in features of the observation.

Source: Agrawal and Goyal 2013, *Thompson Sampling for Contextual Bandits with Linear Payoffs*, arXiv 1209.3352,
algorithm 1.

Differs from the source: a model an option; the noise's deviation is the regression's residual one; what is drawn is
each decision's predicted payoff, which has the distribution that a drawn parameter gives it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hpamdp.policies.shared.context import LinearBandit


class LinThompson(LinearBandit):
    """Choose the option with the highest draw from the posteriors of the predictions.

    `exploration` is the factor of the posteriors' deviation, v of the source; 1 is Bayes.
    """

    def sample(self, mean: Tensor, deviation: Tensor) -> Tensor:
        """Return draws of the predictions."""
        return mean + self.exploration * deviation * torch.randn_like(mean)
