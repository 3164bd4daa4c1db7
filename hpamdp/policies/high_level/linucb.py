"""LinUCB: upper confidence bounds on payoffs that are linear in features of the observation.

Source: Li, Chu, Langford and Schapire 2010, *A Contextual-Bandit Approach to Personalized News Article Recommendation*,
arXiv 1003.0146, algorithm 1 (disjoint models). Discounting: Russac, Vernade and Cappe 2019, arXiv 1909.09146.

Differs from the sources: the width is in units of the regression's residual deviation; the discounted form has one
Gram matrix.
"""

from __future__ import annotations

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from hpamdp.policies.context import Features, LinearBandit
from hpamdp.policies.payoffs import Discount, Memory
from hpamdp.specs import PAMDPSpecs


class LinUCB(LinearBandit):
    """Choose the option with the highest prediction + exploration x its deviation.

    Args:
        specs: of the problem.
        exploration: the factor of the width, alpha of the source.
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
        """Return the upper bounds."""
        return mean + self.exploration * deviation
