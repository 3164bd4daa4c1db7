"""What context-free bandits share: the statistics of each option's rewards, and the greedy choice.

The reward of a bandit is here the return of an option. Nothing else counts, so bandits are for options that last as
long as their episodes.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.policies.base import Selector, is_greedy
from hpamdp.policies.masks import masked_values
from hpamdp.policies.stored_rows import check_choices
from hpamdp.specs import PAMDPSpecs

Memory = Literal["all", "discounted", "sliding_window"]
Discount = Annotated[float, Field(gt=0.0, lt=1.0)]


class RewardStatistics(nn.Module):
    """Weighted counts, sums and sums of squares of each option's rewards.

    Source of the discounted and the sliding-window form: Garivier and Moulines 2011, arXiv 0805.3415, section 2.

    Args:
        num_options: number of options.
        memory: `all` gives every reward the weight 1, `discounted` the weight `discount` to the power of its age in
            decisions, `sliding_window` forgets all but the last `window` decisions.
        discount: used with `discounted` only.
        window: used with `sliding_window` only.

    Attributes:
        counts, sums, squares: of each option's rewards, float64 `[num_options]`.
        recent_options, recent_rewards: of the last decisions, `[window]`, oldest first; the option is -1 where there is
            no decision yet. Empty unless the memory is `sliding_window`.
    """

    counts: Tensor
    sums: Tensor
    squares: Tensor
    recent_options: Tensor
    recent_rewards: Tensor

    def __init__(self, num_options: int, memory: Memory, discount: float, window: int) -> None:
        super().__init__()
        self.memory = memory
        self.discount = discount if memory == "discounted" else 1.0
        # float64, because there may be 10^8 decisions to sum over.
        self.register_buffer("counts", torch.zeros(num_options, dtype=torch.float64))
        self.register_buffer("sums", torch.zeros(num_options, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(num_options, dtype=torch.float64))
        size = window if memory == "sliding_window" else 0
        self.register_buffer("recent_options", torch.full((size,), -1, dtype=torch.long))
        self.register_buffer("recent_rewards", torch.zeros(size, dtype=torch.float64))

    @property
    def means(self) -> Tensor:
        """Mean reward of each option, `[num_options]`; 0 for untried options."""
        return self.sums / self.counts.clamp(min=1e-12)

    @property
    def deviation(self) -> Tensor:
        """Standard deviation of all rewards, a scalar; close to 0 without rewards."""
        total = self.counts.sum().clamp(min=1.0)
        return (self.squares.sum() / total - (self.sums.sum() / total).square()).clamp(min=1e-12).sqrt()

    @property
    def is_untried(self) -> Tensor:
        """Whether no reward of an option is known, bool `[num_options]`; options become untried again if forgotten."""
        return self.counts < 1e-9

    def best(self, allowed: Tensor | None = None) -> int:
        """Return the option with the highest mean reward, among the allowed ones, bool `[num_options]`."""
        # An untried option comes before a forbidden one, whose value is -inf.
        means = torch.where(self.is_untried, torch.finfo(torch.float64).min, self.means)
        return int(masked_values(means, allowed).argmax())

    def weights(self, num: int) -> Tensor:
        """Return the weights of the last `num` decisions, oldest first, `[num]`."""
        return self.discount ** torch.arange(num - 1, -1, -1, device=self.counts.device).double()

    def add(self, options: Tensor, rewards: Tensor) -> None:
        """Add the rewards `[N]` of the options `[N]`, oldest first."""
        rewards = rewards.double()
        if self.memory == "sliding_window":
            size = len(self.recent_options)
            self.recent_options = torch.cat([self.recent_options, options])[-size:]
            self.recent_rewards = torch.cat([self.recent_rewards, rewards])[-size:]
            is_filled = self.recent_options >= 0
            options = self.recent_options[is_filled]
            rewards = self.recent_rewards[is_filled]
            self.counts.zero_()
            self.sums.zero_()
            self.squares.zero_()
        weights = self.weights(len(options))
        fade = self.discount ** len(options)
        self.counts.mul_(fade).index_add_(0, options, weights)
        self.sums.mul_(fade).index_add_(0, options, weights * rewards)
        self.squares.mul_(fade).index_add_(0, options, weights * rewards.square())


class Bandit(Selector):
    """A selector that sees no context: it chooses by the rewards of the options alone. A subclass writes `sample`.

    Args:
        specs: of the problem.
        memory, discount, window: which rewards count, as in `RewardStatistics`.

    Attributes:
        statistics: of the rewards that are known.
        num_decisions: how many decisions of its own have ended, forgotten ones included; those of a data set do not
            count. With the `pending` ones they are the decisions that it has made.
    """

    is_bandit: ClassVar[bool] = True

    num_decisions: Tensor

    def __init__(self, specs: PAMDPSpecs, memory: Memory, discount: float, window: int) -> None:
        super().__init__(specs)
        self.statistics = RewardStatistics(specs.num_options, memory, discount, window)
        self.register_buffer("num_decisions", torch.zeros((), dtype=torch.long))

    @abstractmethod
    def sample(self, num: int, allowed: Tensor | None = None) -> Tensor:
        """Return `num` exploring choices, int64 `[num]`, for decisions that are due at the same time.

        Args:
            num: how many.
            allowed: the options that may be chosen, bool `[num_options]`; None: all.
        """
        raise NotImplementedError

    def best(self, allowed: Tensor | None = None) -> int:
        """Return the greedy choice."""
        return self.statistics.best(allowed)

    def select(self, td: TensorDictBase) -> Tensor:
        """Return the choices `[*B]`: the best option if the policy is greedy, else samples where a decision is due."""
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        mask = td.get(keys.OPTION_MASK, None)
        if mask is not None:
            return self._select_allowed(is_decision, mask)
        if is_greedy():
            return torch.full_like(is_decision, self.best(), dtype=torch.long)
        choices = torch.zeros_like(is_decision, dtype=torch.long)
        chosen = self.sample(int(is_decision.sum()))
        self.pending += torch.bincount(chosen, minlength=self.specs.num_options)
        choices[is_decision] = chosen
        return choices

    def _select_allowed(self, is_decision: Tensor, mask: Tensor) -> Tensor:
        """Return allowed choices `[*B]`: environments that allow the same options are served together.

        Args:
            is_decision: where a choice is due, bool `[*B]`; elsewhere it is ignored.
            mask: the options that may be chosen, bool `[*B, num_options]`.
        """
        choices = torch.zeros_like(is_decision, dtype=torch.long)
        for allowed in mask.flatten(0, -2).unique(dim=0):
            rows = is_decision & (mask == allowed).all(-1)
            if is_greedy():
                choices[rows] = self.best(allowed)
                continue
            chosen = self.sample(int(rows.sum()), allowed)
            self.pending += torch.bincount(chosen, minlength=self.specs.num_options)
            choices[rows] = chosen
        return choices

    def has_updated(self) -> bool:
        """Return whether any reward is known."""
        return bool(self.statistics.counts.any())

    def check_state(self, state: Mapping[str, Any]) -> None:
        """Refuse negative counts and decisions for options that do not exist.

        Raises:
            ValueError: the state is invalid.
        """
        for name, value in state.items():
            if name.endswith(("counts", "squares")) and (value < 0.0).any():
                raise ValueError(f"{name} holds {float(value.min())}, but must be at least 0")
            if name.endswith("recent_options"):
                check_choices({"option": value[value >= 0]}, self.specs)

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Add the rewards of finished decisions, oldest first; return the mean reward of each option."""
        self.num_decisions += len(decisions)
        self.add_demonstrations(decisions)
        means = self.statistics.means.tolist()
        return {f"reward_{name}": mean for name, mean in zip(self.specs.option_names, means, strict=True)}

    def add_demonstrations(self, decisions: TensorDictBase) -> None:
        """Add the rewards of decisions, oldest first."""
        rewards = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1)
        self.statistics.add(decisions.get(keys.OPTION), rewards)
