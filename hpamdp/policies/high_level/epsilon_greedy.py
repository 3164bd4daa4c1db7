"""The best mean payoff, but for a share of random choices that falls.

Source: Sutton and Barto 2018, *Reinforcement Learning: An Introduction*, section 2.2; the share that falls with 1 / t:
Auer, Cesa-Bianchi and Fischer 2002, figure 3. Forgetting forms: see `Payoffs`.
"""

from __future__ import annotations

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from hpamdp.policies.shared.bandit_statistics import Bandit, Discount, Memory
from hpamdp.policies.shared.fractions import Fraction
from hpamdp.specs import PAMDPSpecs


class EpsilonGreedy(Bandit):
    """Choose at random with probability epsilon(t), else the option with the highest mean payoff.

    Args:
        specs: of the problem.
        epsilon_scale: epsilon(t) = epsilon_scale / t at decision t, between `epsilon_final` and 1.
        epsilon_final: where it ends; for payoffs that stand still 0 is right.
        memory, discount, window: which payoffs count, as in `Payoffs`.
    """

    def __init__(
        self,
        specs: PAMDPSpecs,
        *,
        epsilon_scale: PositiveFloat,
        epsilon_final: Fraction,
        memory: Memory,
        discount: Discount,
        window: PositiveInt,
    ) -> None:
        super().__init__(specs, memory, discount, window)
        self.epsilon_scale, self.epsilon_final = epsilon_scale, epsilon_final

    def sample(self, num: int) -> Tensor:
        """Return `num` choices."""
        device = self.rewards.counts.device
        time = self.rewards.num_decisions + torch.arange(1, num + 1, device=device)
        is_random = torch.rand(num, device=device) < (self.epsilon_scale / time).clamp(self.epsilon_final, 1.0)
        anything = torch.randint(self.specs.num_options, (num,), device=device)
        return torch.where(is_random | self.rewards.is_untried.any(), anything, self.best())
