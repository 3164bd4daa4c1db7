"""The base of context-free bandits, and the statistics of each option's rewards.

The reward of a bandit is here the return of an option. A bandit does not bootstrap, so its options must last as long as
their episodes, or as the trips in these.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import Selector
from hpamdp.policies.masks import masked_values
from hpamdp.policies.shared.bandit_options import BANDIT_CARD, BanditOptions
from hpamdp.specs import PAMDPSpecs


def above_all(noise: Tensor) -> Tensor:
    """Return values of untried options, float64: above all rewards, and in the order of `noise`, whose size is 1."""
    return (1e9 + noise) * 2.0**900


class Rewards:
    """What counts, sums and sums of squares of each option's rewards say, `[*B, num_options]` each.

    Attributes:
        counts, sums, squares: float64.
    """

    counts: Tensor
    sums: Tensor
    squares: Tensor

    @property
    def means(self) -> Tensor:
        """Mean reward of each option, `[*B, num_options]`; 0 for untried options."""
        return self.sums / self.counts.clamp(min=1e-12)

    @property
    def deviation(self) -> Tensor:
        """Standard deviation of all rewards together, `[*B, 1]`; close to 0 without rewards."""
        total = self.counts.sum(-1, keepdim=True).clamp(min=1.0)
        mean = self.sums.sum(-1, keepdim=True) / total
        return (self.squares.sum(-1, keepdim=True) / total - mean.square()).clamp(min=1e-12).sqrt()

    @property
    def is_untried(self) -> Tensor:
        """Whether an option has no known reward, bool `[*B, num_options]`. Forgotten options are untried again."""
        return self.counts < 1e-9


class RewardStatistics(nn.Module, Rewards):
    """Weighted counts, sums and sums of squares of each option's rewards.

    Source of the discounted and the sliding-window form: Garivier and Moulines 2011, arXiv 0805.3415, section 2.

    Args:
        num_options: number of options.
        options: which rewards count.

    Attributes:
        counts, sums, squares: of each option's rewards, float64 `[num_options]`.
        recent_options, recent_rewards: of the last decisions, `[window]`, oldest first. The option is -1 if there is no
            decision yet. Both are empty unless the memory is `sliding_window`.
    """

    def __init__(self, num_options: int, options: BanditOptions) -> None:
        super().__init__()
        self.memory = options.memory
        self.discount = options.discount if options.memory == "discounted" else 1.0
        # float64, because there may be 10^8 decisions to sum over.
        self.counts = nn.Buffer(torch.zeros(num_options, dtype=torch.float64))
        self.sums = nn.Buffer(torch.zeros(num_options, dtype=torch.float64))
        self.squares = nn.Buffer(torch.zeros(num_options, dtype=torch.float64))
        size = options.window if options.memory == "sliding_window" else 0
        self.recent_options: Tensor = nn.Buffer(torch.full((size,), -1, dtype=torch.long))
        self.recent_rewards: Tensor = nn.Buffer(torch.zeros(size, dtype=torch.float64))

    @property
    def known_means(self) -> Tensor:
        """Mean reward of each option, `[num_options]`; the lowest finite number for untried options."""
        # Forbidden options have -inf, which is below the value of untried ones.
        return torch.where(self.is_untried, torch.finfo(torch.float64).min, self.means)

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
    """A selector that chooses by the rewards of the options alone, without an observation.

    A subclass writes `sample`. If it has settings of its own, it derives its `Options` from `BanditOptions`.

    Attributes:
        statistics: of the known rewards.
        num_decisions: how many of its own decisions have ended, forgotten ones included. Decisions of a data set do not
            count.
    """

    Options: ClassVar[type[BanditOptions]] = BanditOptions
    card = BANDIT_CARD
    options: BanditOptions

    def __init__(self, specs: PAMDPSpecs, options: BanditOptions | None = None, **settings: Any) -> None:
        super().__init__(specs)
        self.options = self.Options.of(options, settings)
        self.statistics = RewardStatistics(specs.num_options, self.options)
        self.num_decisions: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))

    @abstractmethod
    def sample(self, num: int, allowed: Tensor | None = None) -> Tensor:
        """Return exploring choices, int64 `[num]`, for decisions that are due at the same time.

        Args:
            num: number of decisions.
            allowed: the options that may be chosen, bool `[num_options]`. If None, all may.
        """
        raise NotImplementedError

    @property
    def greedy_values(self) -> Tensor:
        """The number of each option, `[num_options]`, of which the greedy choice takes the highest."""
        return self.statistics.known_means

    def best(self, allowed: Tensor | None = None) -> int:
        """Return the greedy choice.

        Args:
            allowed: the options that may be chosen, bool `[num_options]`. If None, all may.
        """
        return int(masked_values(self.greedy_values, allowed).argmax())

    def greedy_choice(self) -> Callable[[TensorDictBase], Tensor]:
        """Return the choice of the allowed option with the highest of the `greedy_values`."""
        values = self.greedy_values

        def choice(td: TensorDictBase) -> Tensor:
            of_rows = values.expand(*td.get(keys.IS_DECISION).shape[:-1], -1)
            return masked_values(of_rows, td.get(keys.OPTION_MASK, None)).argmax(-1)

        return choice

    def select(self, td: TensorDictBase) -> Tensor:
        """Return the choices `[*B]`: the best option if the policy is greedy, else a sample for each due decision."""
        if is_greedy():
            return self.greedy_choice()(td)
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        mask = td.get(keys.OPTION_MASK, None)
        if mask is not None:
            return self._sample_allowed(is_decision, mask)
        choices = torch.zeros_like(is_decision, dtype=torch.long)
        chosen = self.sample(int(is_decision.sum()))
        self.pending += torch.bincount(chosen, minlength=self.specs.num_options)
        choices[is_decision] = chosen
        return choices

    def _sample_allowed(self, is_decision: Tensor, mask: Tensor) -> Tensor:
        """Return allowed exploring choices `[*B]`. Environments that allow the same options are handled together.

        Args:
            is_decision: where a choice is due, bool `[*B]`. Elsewhere the choice is ignored.
            mask: the options that may be chosen, bool `[*B, num_options]`.
        """
        choices = torch.zeros_like(is_decision, dtype=torch.long)
        for allowed in mask.flatten(0, -2).unique(dim=0):
            rows = is_decision & (mask == allowed).all(-1)
            chosen = self.sample(int(rows.sum()), allowed)
            self.pending += torch.bincount(chosen, minlength=self.specs.num_options)
            choices[rows] = chosen
        return choices

    def has_updated(self) -> bool:
        """Return whether any reward is known."""
        return bool(self.statistics.counts.any())

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Add the rewards of finished decisions, oldest first; return the mean of each option's known rewards."""
        self.num_decisions += len(decisions)
        self.add_demonstrations(decisions)
        statistics, names = self.statistics, self.specs.option_names
        means = zip(names, statistics.means.tolist(), statistics.is_untried.tolist(), strict=True)
        return {f"reward_{name}": mean for name, mean, is_untried in means if not is_untried}

    def add_demonstrations(self, decisions: TensorDictBase) -> None:
        """Add the rewards of decisions, oldest first."""
        rewards = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1)
        self.statistics.add(decisions.get(keys.OPTION), rewards)
