"""Upper confidence bounds on the options' payoffs, for payoffs that stand still (UCB1) or drift.

Source: UCB1: Auer, Cesa-Bianchi and Fischer 2002, *Finite-time analysis of the multiarmed bandit problem*, figure 1.
Discounted and sliding-window UCB: Garivier and Moulines 2011, arXiv 0805.3415, equations 2 to 4.

Differs from the sources:
- payoffs need not lie in [0, 1]: the width is in units of the payoffs' own standard deviation;
- many environments decide at once: they are served one after another, each pull narrowing its arm's width as if its
  payoff were already in, so that a thousand boats do not all follow one estimate.
"""

from __future__ import annotations

import torch
from pydantic import PositiveFloat, PositiveInt
from torch import Tensor

from hpamdp.policies.shared.bandit_statistics import Bandit, Discount, Memory
from hpamdp.specs import PAMDPSpecs


class UCB(Bandit):
    """Choose the option with the highest mean payoff + exploration x deviation x sqrt(2 ln t / n).

    Args:
        specs: of the problem.
        exploration: the factor of the width.
        memory, discount, window: which payoffs count, as in `Payoffs`; with `all` this is UCB1.
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
        """Return `num` choices made one after another, in random order."""
        known = self.rewards
        pulls = torch.arange(num, device=known.counts.device)
        counts = known.counts.unsqueeze(-1) + pulls
        width = (2.0 * (known.counts.sum() + num).clamp(min=2.0).log() / counts).sqrt()
        # An arm without payoffs has an infinite bound and, from its first pull on, the mean of all.
        mean = torch.where(known.is_untried, known.sums.sum() / known.counts.sum().clamp(min=1.0), known.means)
        # An arm's bound falls with each pull, so taking the best arm `num` times over is taking the `num` best bounds.
        bounds = mean.unsqueeze(-1) + self.exploration * known.deviation * width
        chosen = bounds.flatten().topk(num).indices // num
        return chosen[torch.randperm(num, device=chosen.device)]
