"""Thompson sampling: choose each option as often as it is likely to be the best.

Source: Russo, Van Roy, Kazerouni, Osband and Wen 2018, *A Tutorial on Thompson Sampling*, arXiv 1707.02038, section 3.
Forgetting forms: see `Payoffs`.

Differs from the source: the payoffs' variance is the observed one, the prior of the means is flat.
"""

from __future__ import annotations

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from hpamdp.policies.shared.bandit_statistics import Bandit, Discount, Memory
from hpamdp.specs import PAMDPSpecs


class Thompson(Bandit):
    """Choose the option with the highest draw from the Gaussian posteriors of the mean payoffs.

    Args:
        specs: of the problem.
        exploration: factor of the posteriors' deviation; 1 is Bayes.
        memory, discount, window: which payoffs count, as in `Payoffs`.
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

    def sample(self, num: int) -> Tensor:
        """Return `num` choices, each from a draw of its own."""
        known = self.rewards
        noise = torch.randn(num, self.specs.num_options, dtype=torch.float64, device=known.counts.device)
        deviation = self.exploration * known.deviation / known.counts.clamp(min=1e-9).sqrt()
        drawn = known.means + deviation * noise
        return torch.where(known.is_untried, 1e9 + noise, drawn).argmax(-1)
