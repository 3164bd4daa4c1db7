"""The option with the highest mean reward, and a random option with a probability that falls over time.

Source: Sutton and Barto 2018, *Reinforcement Learning: An Introduction*, section 2.2; probability proportional to
1 / t: Auer, Cesa-Bianchi and Fischer 2002, *Finite-time analysis of the multiarmed bandit problem*, figure 3.
Forgetting: see `RewardStatistics`.

Differs from the sources:
- the probability of a random option has a lower bound, `epsilon_final`;
- `epsilon_scale` is a setting. Auer et al. compute it from the number of options and the lead of the best one;
- all choices are random until each allowed option has a known reward that is not forgotten;
- if the policy is greedy, no option is random.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hpamdp.policies.high_level.options import CARDS, EpsilonGreedyOptions
from hpamdp.policies.masks import random_choice
from hpamdp.policies.shared.bandit import Bandit


class EpsilonGreedy(Bandit):
    """Choose a random option with probability epsilon(t), else the option with the highest mean reward.

    t counts the decisions that were made, whether or not their rewards are known.
    """

    Options = EpsilonGreedyOptions
    card = CARDS["EpsilonGreedy"]
    options: EpsilonGreedyOptions

    def sample(self, num: int, allowed: Tensor | None = None) -> Tensor:
        """Return `num` choices. All are random until every allowed option has been tried."""
        device = self.statistics.counts.device
        time = self.num_decisions + self.pending.sum() + torch.arange(1, num + 1, device=device)
        epsilon = (self.options.epsilon_scale / time.float()).clamp(self.options.epsilon_final, 1.0)
        is_random = torch.rand(num, device=device, dtype=torch.float32) < epsilon
        mask = None if allowed is None else allowed.expand(num, -1)
        random_option = random_choice(torch.Size([num]), self.specs.num_options, mask, device)
        is_untried = self.statistics.is_untried if allowed is None else self.statistics.is_untried & allowed
        return torch.where(is_random | is_untried.any(), random_option, self.best(allowed))
