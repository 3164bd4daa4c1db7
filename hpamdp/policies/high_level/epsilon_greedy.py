"""The option with the highest mean reward, and a random option with a probability that falls over time.

Source: Sutton and Barto 2018, *Reinforcement Learning: An Introduction*, section 2.2; probability proportional to
1 / t: Auer, Cesa-Bianchi and Fischer 2002, *Finite-time analysis of the multiarmed bandit problem*, figure 3.
Forgetting: see `RewardStatistics`.
"""

from __future__ import annotations

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from hpamdp.policies.masks import random_choice
from hpamdp.policies.shared.bandit import Bandit, Discount, Memory
from hpamdp.settings import Fraction
from hpamdp.specs import PAMDPSpecs


class EpsilonGreedy(Bandit):
    """Choose a random option with probability epsilon(t), else the option with the highest mean reward.

    Args:
        specs: of the problem.
        epsilon_scale: epsilon(t) = epsilon_scale / t at decision t, clipped to [`epsilon_final`, 1]; t counts the
            decisions that were made, whether or not their rewards are known.
        epsilon_final: lower bound of epsilon(t); 0 suits stationary rewards.
        memory, discount, window: which rewards count, as in `RewardStatistics`.
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
        self.epsilon_scale = epsilon_scale
        self.epsilon_final = epsilon_final

    def sample(self, num: int, allowed: Tensor | None = None) -> Tensor:
        """Return `num` choices; all are random as long as an allowed option is untried."""
        device = self.statistics.counts.device
        time = self.num_decisions + self.pending.sum() + torch.arange(1, num + 1, device=device)
        epsilon = (self.epsilon_scale / time.float()).clamp(self.epsilon_final, 1.0)
        is_random = torch.rand(num, device=device, dtype=torch.float32) < epsilon
        mask = None if allowed is None else allowed.expand(num, -1)
        anything = random_choice(torch.Size([num]), self.specs.num_options, mask, device)
        is_untried = self.statistics.is_untried if allowed is None else self.statistics.is_untried & allowed
        return torch.where(is_random | is_untried.any(), anything, self.best(allowed))
