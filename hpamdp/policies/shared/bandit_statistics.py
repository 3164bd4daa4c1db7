"""What context-free bandits have in common: what each option has paid so far, and the choice of the best mean."""

from __future__ import annotations

from typing import Annotated, Literal

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.policies.base import Selector, is_greedy
from hpamdp.specs import PAMDPSpecs

Memory = Literal["all", "discounted", "sliding_window"]
Discount = Annotated[float, Field(gt=0.0, lt=1.0)]


class RewardStatistics(nn.Module):
    """Counts, sums and sums of squares of the options' payoffs.

    Source of the forgetting forms: Garivier and Moulines 2011, arXiv 0805.3415, section 2.

    Args:
        num_options: how many options.
        memory: `all` counts every payoff the same, `discounted` weighs one by `discount` to the power of its age in
            decisions, `sliding_window` forgets all but the last `window` decisions.
        discount: of the discounted form.
        window: of the sliding-window form.
    """

    def __init__(self, num_options: int, memory: Memory, discount: float, window: int) -> None:
        super().__init__()
        self.memory = memory
        self.discount = discount if memory == "discounted" else 1.0
        # float64: sums over 10^8 decisions.
        for name in ("counts", "sums", "squares"):
            self.register_buffer(name, torch.zeros(num_options, dtype=torch.float64))
        self.register_buffer("num_decisions", torch.zeros((), dtype=torch.long))
        size = window if memory == "sliding_window" else 0
        self.register_buffer("recent_options", torch.full((size,), -1, dtype=torch.long))
        self.register_buffer("recent_rewards", torch.zeros(size, dtype=torch.float64))

    @property
    def means(self) -> Tensor:
        """Mean payoff of each option, `[num_options]`; 0 where nothing is remembered."""
        return self.sums / self.counts.clamp(min=1e-12)

    @property
    def deviation(self) -> Tensor:
        """Standard deviation of all payoffs, a scalar; next to 0 while there are none."""
        total = self.counts.sum().clamp(min=1.0)
        return (self.squares.sum() / total - (self.sums.sum() / total).square()).clamp(min=1e-12).sqrt()

    @property
    def is_untried(self) -> Tensor:
        """Whether nothing is remembered of an option, bool `[num_options]`."""
        return self.counts < 1e-9

    def best(self) -> int:
        """Return the option with the highest mean payoff."""
        return int(torch.where(self.is_untried, -torch.inf, self.means).argmax())

    def weights(self, num: int) -> Tensor:
        """Return the weights of the last `num` decisions, oldest first, `[num]`."""
        return self.discount ** torch.arange(num - 1, -1, -1, device=self.counts.device).double()

    def add(self, options: Tensor, rewards: Tensor) -> None:
        """Take in the payoffs `[N]` of options `[N]`, oldest first."""
        self.num_decisions += len(options)
        rewards = rewards.double()
        if self.memory == "sliding_window":
            size = len(self.recent_options)
            self.recent_options = torch.cat([self.recent_options, options])[-size:]
            self.recent_rewards = torch.cat([self.recent_rewards, rewards])[-size:]
            is_filled = self.recent_options >= 0
            options, rewards = self.recent_options[is_filled], self.recent_rewards[is_filled]
            for total in (self.counts, self.sums, self.squares):
                total.zero_()
        weights = self.weights(len(options))
        fade = self.discount ** len(options)
        for total, value in (
            (self.counts, weights),
            (self.sums, weights * rewards),
            (self.squares, weights * rewards.square()),
        ):
            total.mul_(fade).index_add_(0, options, value)


class Bandit(Selector):
    """A selector that sees no context: it remembers payoffs and draws options. A subclass writes `draw`."""

    def __init__(self, specs: PAMDPSpecs, memory: Memory, discount: float, window: int) -> None:
        super().__init__(specs)
        self.rewards = RewardStatistics(specs.num_options, memory, discount, window)

    def sample(self, num: int) -> Tensor:
        """Return `num` exploring choices, int64 `[num]`, for decisions that are due at once."""
        raise NotImplementedError

    def best(self) -> int:
        """Return the greedy choice."""
        return self.rewards.best()

    def select(self, td: TensorDictBase) -> Tensor:
        """Return the choices `[*B]`: the best option where the policy is greedy, else `draw`s."""
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        if is_greedy():
            return torch.full_like(is_decision, self.best(), dtype=torch.long)
        choices = torch.zeros_like(is_decision, dtype=torch.long)
        choices[is_decision] = self.sample(int(is_decision.sum()))
        return choices

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Take in the finished decisions' payoffs, oldest first; return each option's mean."""
        self.rewards.add(decisions.get(keys.OPTION), decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1))
        return {f"reward_{name}": self.rewards.means[i].item() for i, name in enumerate(self.specs.option_names)}
