"""Which option practises while its learner still improves. Whom to trust is the selector's question, not this one.

A selector sees the returns of learners that improve with practice. It settles on the option whose learner improves
first, and the others never practise enough to show what they can do. So another rule decides who practises:

- A curve is fitted to the returns of each option over its own practice.
- An option behind the best one practises if it would gain more from the practice that is left: the more it would gain,
  the more often.
- Otherwise, in the first half of the run all options practise equally, except those whose curve stays out of reach of
  the best one. In the second half the selector chooses, so that learners practise where they will be used.

Sources: Heidari, Kearns and Roth 2016, *Tight Policy Regret Bounds for Improving and Decaying Bandits*, and Metelli,
Trovo, Pirola and Restelli 2022, *Stochastic Rising Bandits*: options whose reward rises with their own pulls, compared
by the reward that they would reach by the horizon.

Differs from the sources:
- what counts is the final greedy agent, not the regret on the way, so the option that gains most practises, not the one
  that will have the highest return;
- curves are exponentials, not lines through the last returns. Lines promise more the noisier the returns are;
- the selector sees the state, so one option can be the best in some states and another one elsewhere.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

NUM_BINS = 100
"""Bins of an option's own practice: each is this fraction of the run."""
FIRST_BINS = 4
"""Bins that every option fills first, before any curve is fitted."""
UNIFORM_UNTIL = 0.5
"""Fraction of the run in which all options that could become the best one practise equally."""
LATE_UNIFORM = 0.05
"""Fraction of the later decisions that stay uniform practice. They find options that begin to improve late."""
CLEAR_ADVANTAGE = 0.4
"""Difference of gains, in standard deviations of a return, from which the option behind gets all decisions."""
OUT_OF_REACH = 3.0
"""Distance to the best option, in standard deviations of a return, from which an option need not practise."""


class Practice(nn.Module):
    """How much each option has practised, and which ones practise whatever the selector would choose.

    Here all options practise equally for the first steps of a run.

    Args:
        num_options: number of options.
        uniform_steps: for how many steps; of decisions, if the learners are frozen.

    Attributes:
        own: steps that each option has practised, float64 `[num_options]`.
    """

    added_later: tuple[str, ...] = ("own",)  # checkpoints of 0.3 lack it
    own: Tensor

    def __init__(self, num_options: int, uniform_steps: int = 0) -> None:
        super().__init__()
        self.uniform_steps = uniform_steps
        self.register_buffer("own", torch.zeros(num_options, dtype=torch.float64))

    def probabilities(self, frames: int) -> Tensor:
        """Return the probability `[num_options]` with which each option practises after so many steps of the run.

        With the remaining probability the selector chooses.
        """
        return torch.full_like(self.own, float(frames < self.uniform_steps) / len(self.own)).float()

    def add(self, options: Tensor, decided: Tensor, returns: Tensor) -> None:
        """Count practice, and the returns that tell how it goes.

        Args:
            options: the option of each step, int64 `[N]`.
            decided: the option of each decision that has ended, int64 `[M]`.
            returns: its return, `[M]`.
        """
        self.own += torch.bincount(options, minlength=len(self.own))


class CurvePractice(Practice):
    """By fitted learning curves: see the head of this file.

    Args:
        num_options: number of options.
        total: length of the run in steps.

    Attributes:
        width: steps in a bin.
        counts, sums, squares: of the returns in each bin of an option's own practice, float64
            `[num_options, NUM_BINS]`.
    """

    added_later = ("own", "width", "counts", "sums", "squares")
    width: Tensor
    counts: Tensor
    sums: Tensor
    squares: Tensor

    def __init__(self, num_options: int, total: int) -> None:
        super().__init__(num_options)
        self.total = total
        self.register_buffer("width", torch.tensor(total / NUM_BINS, dtype=torch.float64))
        for name in ("counts", "sums", "squares"):
            self.register_buffer(name, torch.zeros(num_options, NUM_BINS, dtype=torch.float64))

    def add(self, options: Tensor, decided: Tensor, returns: Tensor) -> None:
        """Count practice and returns; see `Practice.add`."""
        returns = returns.double()
        place = decided * NUM_BINS + self._bin()[decided]
        for name, values in (("counts", torch.ones_like(returns)), ("sums", returns), ("squares", returns.square())):
            getattr(self, name).view(-1).index_add_(0, place, values)
        super().add(options, decided, returns)

    def probabilities(self, frames: int) -> Tensor:
        """Return the probabilities of practice by the curves; see `Practice.probabilities`."""
        num_options, is_first_half = len(self.own), frames < UNIFORM_UNTIL * self.total
        if is_first_half and (self._bin() < FIRST_BINS).any():
            is_first = self.own == self.own.min()
            return is_first.float() / is_first.sum()
        level, gain = self.curves(max(0, self.total - frames))
        deviation = self._noise().sqrt()
        is_in_reach = level + gain + OUT_OF_REACH * deviation >= level.max()
        gain = torch.where(is_in_reach, gain, 0.0)
        is_best = gain == gain.max()
        advantage = ((gain.max() - gain[level.argmax()]) / (CLEAR_ADVANTAGE * deviation)).clamp(max=1.0)
        share = advantage * is_best / is_best.sum()
        if is_first_half:
            share += (1.0 - advantage) * is_in_reach / is_in_reach.sum()
        return (LATE_UNIFORM / num_options + (1.0 - LATE_UNIFORM) * share).float()

    def curves(self, steps: int) -> tuple[Tensor, Tensor]:
        """Return each option's return now, and by how much so many more steps of practice would raise it.

        Both are `[num_options]`; -inf and 0 for an option without returns. A curve is a + b exp(-n / tau) over the own
        practice n, with b <= 0. For each tau of a grid the least squares fit to the bins' means has a closed form. The
        result is the mean over tau, weighted by the likelihood.
        """
        tau = self.width * NUM_BINS * torch.logspace(-2.0, 0.5, 16, dtype=torch.float64, device=self.own.device)
        middle = (torch.arange(NUM_BINS, device=self.own.device) + 0.5) * self.width
        shape = torch.exp(-middle / tau.unsqueeze(-1))  # [16, NUM_BINS]
        mean = (self.sums / self.counts.clamp(min=1.0)).unsqueeze(1)  # [num_options, 1, NUM_BINS]
        weight = (self.counts / self.counts.sum(-1, keepdim=True).clamp(min=1.0)).unsqueeze(1)
        mean_of_all, shape_of_all = (weight * mean).sum(-1), (weight * shape).sum(-1)  # [num_options, 1 or 16]
        mean, shape = mean - mean_of_all.unsqueeze(-1), shape - shape_of_all.unsqueeze(-1)
        covariance, variance = (weight * shape * mean).sum(-1), (weight * shape.square()).sum(-1)
        b = (covariance / variance.clamp(min=1e-9)).clamp(max=0.0)
        error = self.counts.sum(-1, keepdim=True) * (b.square() * variance - 2.0 * b * covariance)
        likelihood = (-0.5 * error / self._noise()).softmax(-1)
        now = torch.exp(-self.own.unsqueeze(-1) / tau)
        level = mean_of_all + b * (now - shape_of_all)
        gain = b * now * torch.expm1(-steps / tau)
        is_known = self.counts.any(-1)
        return torch.where(is_known, (likelihood * level).sum(-1), -torch.inf), (likelihood * gain).sum(-1)

    def _bin(self) -> Tensor:
        """Return the bin `[num_options]` that each option's next return belongs to."""
        return (self.own / self.width).long().clamp(max=NUM_BINS - 1)

    def _noise(self) -> Tensor:
        """Return the variance of the returns within a bin, a scalar."""
        within = self.squares - self.sums.square() / self.counts.clamp(min=1.0)
        return within.sum().clamp(min=1e-6) / (self.counts - 1.0).clamp(min=0.0).sum().clamp(min=1.0)
