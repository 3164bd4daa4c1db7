"""Thompson sampling for payoffs that are linear in features of the observation.

Source: Agrawal and Goyal 2013, *Thompson Sampling for Contextual Bandits with Linear Payoffs*, arXiv 1209.3352,
algorithm 1.

Differs from the source: a model an option; the noise's deviation is the regression's residual one; what is drawn is
each decision's predicted payoff, which has the distribution that a drawn parameter gives it.
"""

from __future__ import annotations

import torch
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from hpamdp.policies.context import Features, LinearBandit
from hpamdp.policies.payoffs import Discount, Memory
from hpamdp.specs import PAMDPSpecs


class LinThompson(LinearBandit):
    """Choose the option with the highest draw from the posteriors of the predictions.

    Args:
        specs: of the problem.
        exploration: factor of the posteriors' deviation, v of the source; 1 is Bayes.
        inputs, features, degree, ridge, memory, discount, window: as in `LinearBandit`.
    """

    def __init__(
        self,
        specs: PAMDPSpecs,
        *,
        exploration: PositiveFloat,
        inputs: list[NonNegativeInt] | None,
        features: Features,
        degree: PositiveInt,
        ridge: PositiveFloat,
        memory: Memory,
        discount: Discount,
        window: PositiveInt,
    ) -> None:
        forgetting = dict(memory=memory, discount=discount, window=window)
        super().__init__(specs, inputs=inputs, features=features, degree=degree, ridge=ridge, **forgetting)
        self.exploration = exploration

    def draw(self, mean: Tensor, deviation: Tensor) -> Tensor:
        """Return draws of the predictions."""
        return mean + self.exploration * deviation * torch.randn_like(mean)
