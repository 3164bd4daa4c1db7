"""Upper confidence bounds on the rewards of the options, stationary (UCB1) or not.

Source: UCB1: Auer, Cesa-Bianchi and Fischer 2002, *Finite-time analysis of the multiarmed bandit problem*, figure 1.
Discounted and sliding-window UCB: Garivier and Moulines 2011, arXiv 0805.3415, equations 2 to 4.

Differs from the sources:
- rewards need not lie in [0, 1]: the width is in units of their standard deviation;
- many environments decide at the same time. `UCB` simulates sequential decisions: each choice narrows the bound of its
  option before the reward is known. Otherwise all environments would choose the same option;
- with `memory=session` each environment has bounds of its own, on the rewards of its session's trips;
- t also counts the decisions that are due;
- all memories have the width of UCB1. Garivier and Moulines have a constant xi in place of 2, and double the width of
  the discounted form;
- if the policy is greedy, it chooses the highest mean, without a bound. With `memory=session` it uses the bounds even
  then.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hpamdp.policies.high_level.options import CARDS, UCBOptions
from hpamdp.policies.shared.session_bandit import SessionBandit, SessionRewards


class UCB(SessionBandit):
    """Choose the option with the highest mean reward + exploration x standard deviation x sqrt(2 ln t / n).

    The mean is that of the known rewards. n counts the choices of the option and t the choices of all options, whether
    or not their rewards are known.
    """

    Options = UCBOptions
    card = CARDS["UCB"]
    options: UCBOptions

    def sample(self, num: int, allowed: Tensor | None = None) -> Tensor:
        """Return `num` choices as if made one after another, in random order."""
        statistics = self.statistics
        chosen_before = statistics.counts + self.pending
        earlier_choices = torch.arange(num, device=chosen_before.device)
        counts = chosen_before.unsqueeze(-1) + earlier_choices
        width = (2.0 * (chosen_before.sum() + num).clamp(min=2.0).log() / counts).sqrt()
        # The bound of an untried option is infinite; once it is chosen, its mean is taken to be that of all rewards.
        mean_of_all = statistics.sums.sum() / statistics.counts.sum().clamp(min=1.0)
        means = torch.where(statistics.is_untried, mean_of_all, statistics.means)
        # bounds[i, j] is the bound of option i after j of these choices. It falls with j, so choosing the highest bound
        # `num` times in a row means choosing the `num` highest bounds.
        bounds = means.unsqueeze(-1) + self.options.exploration * statistics.deviation * width
        if allowed is not None:
            bounds = bounds.masked_fill(~allowed.unsqueeze(-1), -torch.inf)
        chosen = bounds.flatten().topk(num).indices // num
        return chosen[torch.randperm(num, device=chosen.device)]

    def session_values(self, rewards: SessionRewards) -> Tensor:
        """Return the bounds of each session; infinite for untried options, the first of which is chosen."""
        time = rewards.counts.sum(-1, keepdim=True) + 1.0
        width = (2.0 * time.clamp(min=2.0).log() / rewards.counts.clamp(min=1.0)).sqrt()
        bounds = rewards.means + self.options.exploration * rewards.deviation * width
        return torch.where(rewards.is_untried, torch.inf, bounds)
