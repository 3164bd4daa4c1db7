"""Decide which option practises while its learner still improves. The selector decides which option is best.

A selector sees the returns of learners that improve with practice. It settles on the option whose learner improves
first, and the others never practise enough to show what they can do. So another rule decides who practises:

- A curve is fitted to the returns of each option over its own practice.
- Of the options behind the best one, the one that would gain most from the practice that is left practises, if it would
  gain more than the best one does: the more it would gain, the more often.
- Otherwise, in the first half of the run all options practise for equally many steps, except those whose curve stays
  out of reach of the best one. In the second half the selector chooses, so that learners practise where they will be
  used.

Sources: Heidari, Kearns and Roth 2016, *Tight Policy Regret Bounds for Improving and Decaying Bandits*, and Metelli,
Trovo, Pirola and Restelli 2022, *Stochastic Rising Bandits*: options whose reward rises with their own pulls, compared
by the reward that they would reach by the horizon.

Differs from the sources:
- what counts is the final greedy agent, not the regret on the way, so the option that gains most practises, not the one
  that will have the highest return;
- curves are exponentials, not lines through the last returns. Lines promise more the noisier the returns are;
- the selector sees the state, so one option can be the best in some states and another one elsewhere;
- in the second half returns come from the states that the selector picks, so part of a curve's rise is its choice;
- an option that becomes worse is fitted by a constant, the mean of all its returns.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

NUM_BINS = 100
"""Bins of an option's own practice: each is this fraction of the run."""
FIRST_BINS = 4
"""Bins that every option fills first, before any curve is fitted."""
UNIFORM_UNTIL = 0.5
"""Fraction of the run in which all options that could become the best one practise for equally many steps."""
ALWAYS_UNIFORM = 0.05
"""Fraction of the decisions that are equal practice throughout. They find options that begin to improve late."""
CLEAR_ADVANTAGE = 0.4
"""Difference of gains, in standard deviations of a return, from which the option behind gets all decisions."""
OUT_OF_REACH = 2.0
"""Distance to the best option, in standard deviations of a return, from which an option need not practise."""
RECENT_BINS = 10
"""Bins of an option's own practice that tell how long its decisions are now."""


class Practice(nn.Module):
    """Count each option's practice, and overrule the selector: all options practise equally for the first steps.

    Args:
        num_options: number of options.
        uniform_steps: for how many steps of the run; if the learners are frozen, for how many decisions.

    Attributes:
        own_steps: steps that each option has practised, float64 `[num_options]`.
    """

    added_later: ClassVar[tuple[str, ...]] = ("own_steps",)  # checkpoints of 0.3 lack it

    def __init__(self, num_options: int, uniform_steps: int = 0) -> None:
        super().__init__()
        self.uniform_steps = uniform_steps
        self.own_steps: Tensor = nn.Buffer(torch.zeros(num_options, dtype=torch.float64))

    @property
    def can_overrule(self) -> bool:
        """Whether the selector is overruled at any time of the run."""
        return self.uniform_steps > 0

    def probabilities(self, frames: int) -> Tensor:
        """Return the probability `[num_options]` with which each option practises after so many steps of the run.

        With the remaining probability the selector chooses.
        """
        return torch.full_like(self.own_steps, float(frames < self.uniform_steps) / len(self.own_steps)).float()

    def add(self, options: Tensor, decided: Tensor, returns: Tensor) -> None:
        """Count the steps that each option practised, and record its returns.

        Args:
            options: the option of each step, int64 `[N]`.
            decided: the option of each decision that has ended, int64 `[M]`.
            returns: its return, `[M]`.
        """
        self.own_steps += torch.bincount(options, minlength=len(self.own_steps))


class CurvePractice(Practice):
    """Let options practise by fitted learning curves: see the head of this file.

    Args:
        num_options: number of options.
        total: length of the run in steps.

    Attributes:
        width: steps in a bin.
        counts, sums, squares: of the returns in each bin of an option's own practice, float64
            `[num_options, NUM_BINS]`.
    """

    added_later = ("own_steps", "width", "counts", "sums", "squares")
    can_overrule = True

    def __init__(self, num_options: int, total: int) -> None:
        super().__init__(num_options)
        self.total = total
        self.width: Tensor = nn.Buffer(torch.tensor(total / NUM_BINS, dtype=torch.float64))
        self.counts = nn.Buffer(torch.zeros(num_options, NUM_BINS, dtype=torch.float64))
        self.sums = nn.Buffer(torch.zeros_like(self.counts))
        self.squares = nn.Buffer(torch.zeros_like(self.counts))

    def add(self, options: Tensor, decided: Tensor, returns: Tensor) -> None:
        """Count steps and record returns; see `Practice.add`."""
        returns = returns.double()
        place = decided * NUM_BINS + self._bin()[decided]
        for name, values in (("counts", torch.ones_like(returns)), ("sums", returns), ("squares", returns.square())):
            getattr(self, name).view(-1).index_add_(0, place, values)
        super().add(options, decided, returns)
        while self.own_steps.max() > NUM_BINS * self.width:  # a resumed run may be longer than planned
            for bins in (self.counts, self.sums, self.squares):
                pairs = bins.unflatten(-1, (-1, 2)).sum(-1)
                bins.copy_(torch.cat([pairs, torch.zeros_like(pairs)], -1))
            self.width *= 2.0

    def probabilities(self, frames: int) -> Tensor:
        """Return the probabilities of practice by the curves; see `Practice.probabilities`."""
        is_first_half = frames < UNIFORM_UNTIL * self.total
        is_new = self._bin() < FIRST_BINS
        if is_first_half and is_new.any():
            return is_new.float() / is_new.sum()
        level, gain = self.curves(max(0, self.total - frames))
        deviation = self._noise().sqrt()
        is_in_reach = level + gain + OUT_OF_REACH * deviation >= level.max()
        gain = torch.where(is_in_reach, gain, 0.0)
        gains_most = gain == gain.max()
        advantage = ((gain.max() - gain[level.argmax()]) / (CLEAR_ADVANTAGE * deviation)).clamp(max=1.0)
        probability = advantage * gains_most / gains_most.sum()
        equal_steps = 1.0 / self._decision_steps()
        if is_first_half:
            is_in_reach |= ~self.counts.any(-1)  # its first episode still goes on
            probability += (1.0 - advantage) * is_in_reach * equal_steps / (is_in_reach * equal_steps).sum()
        return (ALWAYS_UNIFORM * equal_steps / equal_steps.sum() + (1.0 - ALWAYS_UNIFORM) * probability).float()

    def curves(self, steps: int) -> tuple[Tensor, Tensor]:
        """Return each option's return now, and its gain from so many more steps of practice, `[num_options]` each.

        They are -inf and 0 for an option without returns. A curve is a + b exp(-n / tau) over the own practice n, with
        b <= 0. For each tau of a grid the least squares fit to the bins' means has a closed form. The result is the
        mean over tau, weighted by the likelihood.
        """
        tau = self.width * NUM_BINS * torch.logspace(-2.0, 0.5, 16, dtype=torch.float64, device=self.width.device)
        bin_centres = (torch.arange(NUM_BINS, device=self.width.device) + 0.5) * self.width
        decay = torch.exp(-bin_centres / tau.unsqueeze(-1))  # [16, NUM_BINS]
        mean = (self.sums / self.counts.clamp(min=1.0)).unsqueeze(1)  # [num_options, 1, NUM_BINS]
        weight = (self.counts / self.counts.sum(-1, keepdim=True).clamp(min=1.0)).unsqueeze(1)
        mean_of_all, decay_of_all = (weight * mean).sum(-1), (weight * decay).sum(-1)  # [num_options, 1 or 16]
        mean, decay = mean - mean_of_all.unsqueeze(-1), decay - decay_of_all.unsqueeze(-1)
        covariance, variance = (weight * decay * mean).sum(-1), (weight * decay.square()).sum(-1)
        b = (covariance / variance.clamp(min=1e-9)).clamp(max=0.0)
        excess_error = self.counts.sum(-1, keepdim=True) * (b.square() * variance - 2.0 * b * covariance)
        likelihood = (-0.5 * excess_error / self._noise()).softmax(-1)
        now = torch.exp(-self.own_steps.unsqueeze(-1) / tau)
        level = mean_of_all + b * (now - decay_of_all)
        gain = b * now * torch.expm1(-steps / tau)
        is_known = self.counts.any(-1)
        return torch.where(is_known, (likelihood * level).sum(-1), -torch.inf), (likelihood * gain).sum(-1)

    def _bin(self) -> Tensor:
        """Return the bin `[num_options]` that each option's next return belongs to."""
        return (self.own_steps / self.width).long().clamp(max=NUM_BINS - 1)

    def _decision_steps(self) -> Tensor:
        """Return the mean length `[num_options]` of each option's recent decisions in steps, at least 1.

        An option without any has the mean of all its decisions, or else the mean of all options.
        """
        total = self.counts.sum(-1)
        of_all = self.own_steps.sum() / total.sum().clamp(min=1.0)
        of_option = torch.where(total > 0.0, self.own_steps / total.clamp(min=1.0), of_all)
        first = (self._bin() - RECENT_BINS).clamp(min=0)
        is_recent = torch.arange(NUM_BINS, device=first.device) >= first.unsqueeze(-1)
        decisions = (self.counts * is_recent).sum(-1)
        recent = (self.own_steps - first * self.width) / decisions.clamp(min=1.0)
        return torch.where(decisions > 0.0, recent, of_option).clamp(min=1.0)

    def _noise(self) -> Tensor:
        """Return the variance of the returns within a bin, a scalar; at least a thousandth of that of all returns."""
        within = (self.squares - self.sums.square() / self.counts.clamp(min=1.0)).sum()
        degrees_of_freedom = (self.counts - 1.0).clamp(min=0.0).sum().clamp(min=1.0)
        total = self.counts.sum().clamp(min=1.0)
        of_all = self.squares.sum() / total - (self.sums.sum() / total).square()
        return torch.maximum(within / degrees_of_freedom, 1e-3 * of_all).clamp(min=1e-12)
