"""Thompson sampling: choose each option with the probability that it is the best one.

Source: Russo, Van Roy, Kazerouni, Osband and Wen 2018, *A Tutorial on Thompson Sampling*, arXiv 1707.02038, section 3.
Forgetting: see `RewardStatistics`.

Differs from the source:
- rewards are Gaussian, not Bernoulli;
- their variance is the observed one, of all options' rewards together;
- the prior of the means is flat, so untried options come first, in random order;
- decisions that are due at the same time sample from the same posteriors;
- with `memory=session` each environment has posteriors of its own, from the rewards of its session's trips;
- if the policy is greedy, it chooses the highest mean. With `memory=session` it samples even then.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hpamdp.policies.high_level.options import CARDS, ThompsonOptions
from hpamdp.policies.masks import masked_values
from hpamdp.policies.shared.bandit import Rewards, above_all
from hpamdp.policies.shared.session_bandit import SessionBandit, SessionRewards


class Thompson(SessionBandit):
    """Choose the option with the highest sample from the Gaussian posterior distributions of the mean rewards."""

    Options = ThompsonOptions
    card = CARDS["Thompson"]
    options: ThompsonOptions

    def sample(self, num: int, allowed: Tensor | None = None) -> Tensor:
        """Return `num` choices, each from its own samples."""
        noise = torch.randn(num, self.specs.num_options, dtype=torch.float64, device=self.statistics.counts.device)
        return masked_values(self._sampled(self.statistics, noise), allowed).argmax(-1)

    def session_values(self, rewards: SessionRewards) -> Tensor:
        """Return samples of the mean rewards in each session; untried options come first, in random order."""
        return self._sampled(rewards, torch.randn_like(rewards.means))

    def _sampled(self, rewards: Rewards, noise: Tensor) -> Tensor:
        """Return samples of the mean rewards by standard normal noise; untried options come first, in random order."""
        deviation = self.options.exploration * rewards.deviation / rewards.counts.clamp(min=1e-9).sqrt()
        return torch.where(rewards.is_untried, above_all(noise), rewards.means + deviation * noise)
