"""Upper confidence bounds on the options' payoffs, for payoffs that stand still (UCB1) or drift.

Source: UCB1: Auer, Cesa-Bianchi and Fischer 2002, *Finite-time analysis of the multiarmed bandit problem*, figure 1.
Discounted and sliding-window UCB: Garivier and Moulines 2011, arXiv 0805.3415, equations 2 to 4.

Differs from the sources:
- payoffs need not lie in [0, 1]: the width is in units of the payoffs' own standard deviation;
- many environments decide at once: they are served one after another, each pull narrowing its arm's width as if its
  payoff were already in, so that a thousand boats do not all follow one estimate.
"""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from pydantic import Field, PositiveFloat, PositiveInt
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, exploration_type

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.specs import PAMDPSpecs


class UCB(Selector):
    """Choose the option with the highest mean payoff + exploration x deviation x sqrt(2 ln t / n).

    Args:
        specs: of the problem.
        exploration: the factor of the width.
        variant: `ucb1` counts every payoff the same, `discounted` weighs one by `discount` to the power of its age in
            decisions, `sliding_window` forgets all but the last `window` decisions.
        discount: of the discounted form.
        window: of the sliding-window form.
    """

    def __init__(
        self,
        specs: PAMDPSpecs,
        *,
        exploration: PositiveFloat,
        variant: Literal["ucb1", "discounted", "sliding_window"],
        discount: Annotated[float, Field(gt=0.0, lt=1.0)],
        window: PositiveInt,
    ) -> None:
        super().__init__(specs)
        self.exploration, self.variant = exploration, variant
        self.discount = discount if variant == "discounted" else 1.0
        # float64: sums over 10^8 decisions.
        self.register_buffer("counts", torch.zeros(specs.num_options, dtype=torch.float64))
        self.register_buffer("sums", torch.zeros(specs.num_options, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(specs.num_options, dtype=torch.float64))
        size = window if variant == "sliding_window" else 0
        self.register_buffer("recent_options", torch.full((size,), -1, dtype=torch.long))
        self.register_buffer("recent_payoffs", torch.zeros(size, dtype=torch.float64))

    @property
    def means(self) -> Tensor:
        """Mean payoff of each option, `[num_options]`; 0 where it was never chosen."""
        return self.sums / self.counts.clamp(min=1e-12)

    def select(self, td: TensorDictBase) -> Tensor:
        """Return the choices `[*B]`: the best mean where the policy is greedy, else the highest bounds in turn."""
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        if exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE):
            means = torch.where(self.counts > 0, self.means, -torch.inf)
            return torch.full_like(is_decision, int(means.argmax()), dtype=torch.long)
        choices = torch.zeros_like(is_decision, dtype=torch.long)
        choices[is_decision] = self._serve(int(is_decision.sum()))
        return choices

    def _serve(self, num: int) -> Tensor:
        """Return `num` choices made one after another, in random order."""
        total = self.counts.sum()
        mean = self.sums.sum() / total.clamp(min=1.0)
        deviation = (self.squares.sum() / total.clamp(min=1.0) - mean.square()).clamp(min=1e-12).sqrt()
        pulls = torch.arange(num, device=self.counts.device)
        counts = self.counts.unsqueeze(-1) + pulls
        width = (2.0 * (total + num).clamp(min=2.0).log() / counts).sqrt()
        # An arm's bound falls with each pull, so taking the best arm `num` times over is taking the `num` best bounds.
        # An arm without payoffs has an infinite one; the term in `pulls` lets such arms take turns.
        bounds = self.means.unsqueeze(-1) + self.exploration * deviation * width
        bounds = torch.where(self.counts.unsqueeze(-1) < 1e-9, 1e9 - pulls.double(), bounds)
        chosen = bounds.flatten().topk(num).indices // num
        return chosen[torch.randperm(num, device=chosen.device)]

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Take in the finished decisions' payoffs, oldest first; return each option's mean and share."""
        options = decisions.get(keys.OPTION)
        payoffs = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1).double()
        if self.variant == "sliding_window":
            size = len(self.recent_options)
            self.recent_options = torch.cat([self.recent_options, options])[-size:]
            self.recent_payoffs = torch.cat([self.recent_payoffs, payoffs])[-size:]
            known = self.recent_options >= 0
            options, payoffs = self.recent_options[known], self.recent_payoffs[known]
            for total in (self.counts, self.sums, self.squares):
                total.zero_()
        age = torch.arange(len(options) - 1, -1, -1, device=options.device)
        weights = self.discount ** age.double()
        fade = self.discount ** len(options)
        for total, value in (
            (self.counts, weights),
            (self.sums, weights * payoffs),
            (self.squares, weights * payoffs.square()),
        ):
            total.mul_(fade).index_add_(0, options, value)
        names = self.specs.option_names
        return {f"payoff_{name}": self.means[i].item() for i, name in enumerate(names)}
