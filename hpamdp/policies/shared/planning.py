"""What planners in a learned model share: a step's prediction, its share of a return, and the weights of the elites."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import torch
from torch import Tensor


class Prediction(NamedTuple):
    """What a model predicts for one step; E is the number of its members, where they differ."""

    next_state: Tensor  # [B, observation_dim] or [E, B, observation_dim], if the step does not terminate
    continuing: Tensor  # [E, B] reward if the step does not terminate
    terminating: Tensor  # [E, B] reward if it does
    logit: Tensor  # [E, B] of termination


def discounted_return(steps: Iterable[Prediction], gamma: float) -> Tensor:
    """Return the discounted sum `[E, B]` of the expected rewards of consecutive steps.

    A step's reward is weighted by the probability that no step before it terminates.
    """
    total: Tensor | float = 0.0
    survival: Tensor | float = 1.0
    for h, step in enumerate(steps):
        ends = step.logit.float().sigmoid()
        reward = ends * step.terminating + (1.0 - ends) * step.continuing
        total = total + gamma**h * survival * reward.float()
        survival = survival * (1.0 - ends)
    assert isinstance(total, Tensor)
    return total


def elite_weights(returns: Tensor, num_elites: int, temperature: float) -> tuple[Tensor, Tensor]:
    """Return of candidates' returns `[*B, S]` the best ones' places and their weights, `[*B, num_elites]` each.

    The weights are exp(return / temperature), normalised.
    """
    best, place = returns.topk(num_elites, -1)
    return place, (best / temperature).softmax(-1)


Returns = Callable[[Tensor, Tensor], Tensor]


class Found(NamedTuple):
    """The first step of the best sequence for each of N states, and the sequence's predicted return."""

    discrete: Tensor  # int64 [N]
    own: Tensor  # [N, D] in [-1, 1]: parameters of the discrete action, 0 past its own
    value: Tensor  # [N]


class SequenceSearch:
    """Find good sequences of parameterised actions: each sequence of discrete actions has Gaussians of its own.

    At first, every sequence of discrete actions is tried with a few samples of the parameters; if there are more than
    `max_sequences`, so many random ones, in which the first actions occur equally often. Then the best `num_kept` of
    them are refined: in each iteration, samples from a Gaussian for every parameter, whose mean and deviation are those
    of the elites of the iteration before.

    A discrete action alone does not say what is done next: with a categorical distribution for each step, as in
    cross-entropy planning over mixed actions, sequences whose parameters should differ share one Gaussian.

    Args:
        parameter_dims: number of parameters of each discrete action.
        horizon: number of steps in a sequence.
        max_sequences: largest number of discrete sequences tried.
        num_kept: number of sequences that are refined.
        num_samples: parameter samples for each sequence in an iteration.
        num_elites: number of the best of them that define the next iteration's Gaussians.
        num_iterations: number of iterations, the first one included.
        temperature: of the elites' weights exp(return / temperature).
        min_deviation: smallest standard deviation of a parameter, in [-1, 1] units.

    Raises:
        ValueError: more elites than samples, or a search that would try more than 1,000,000,000 actions.
    """

    def __init__(
        self,
        parameter_dims: tuple[int, ...],
        *,
        horizon: int,
        max_sequences: int,
        num_kept: int,
        num_samples: int,
        num_elites: int,
        num_iterations: int,
        temperature: float,
        min_deviation: float,
    ) -> None:
        if num_elites > num_samples:
            raise ValueError(f"num_elites={num_elites}, but must be at most num_samples={num_samples}")
        if horizon * max_sequences * num_samples * num_iterations > 1e9:
            raise ValueError(
                f"horizon={horizon}, max_sequences={max_sequences}, num_samples={num_samples}, "
                f"num_iterations={num_iterations}: a plan would try more than 1,000,000,000 actions"
            )
        self.num_discrete = len(parameter_dims)
        self.horizon = horizon
        self.max_sequences = max_sequences
        self.num_kept = num_kept
        self.num_samples = num_samples
        self.num_elites = num_elites
        self.num_iterations = num_iterations
        self.temperature = temperature
        self.min_deviation = min_deviation
        own = torch.arange(max(parameter_dims)) < torch.tensor(parameter_dims).unsqueeze(-1)
        self.has_slot = own.float()  # [num_discrete, D]

    @property
    def num_sequences(self) -> int:
        """How many sequences the first iteration tries."""
        return min(self.max_sequences, self.num_discrete**self.horizon)

    def sequences(self, num_states: int, device: torch.device) -> Tensor:
        """Return the discrete sequences of the first iteration, int64 `[N, Q, horizon]`."""
        if self.num_sequences == self.num_discrete**self.horizon:
            number = torch.arange(self.num_sequences, device=device).expand(num_states, -1)
            digits = [number // self.num_discrete**h % self.num_discrete for h in reversed(range(self.horizon))]
            return torch.stack(digits, -1)
        shape = num_states, self.num_sequences, self.horizon
        sampled = torch.randint(self.num_discrete, shape, device=device)
        begin = torch.randint(self.num_discrete, (num_states, 1), device=device)
        sampled[..., 0] = (begin + torch.arange(self.num_sequences, device=device)) % self.num_discrete
        return sampled

    def __call__(self, returns: Returns, num_states: int, device: torch.device) -> Found:
        """Search for `num_states` states at once.

        Args:
            returns: maps sequences of discrete actions int64 `[N, Q, horizon]` and samples of their own parameters
                `[N, Q, S, horizon, D]` to returns `[N, Q, S]`.
            num_states: N.
            device: where to search.
        """
        has_slot = self.has_slot.to(device)
        discrete = self.sequences(num_states, device)
        mask = has_slot[discrete]
        mean = torch.zeros_like(mask)
        deviation = torch.ones_like(mask)
        for iteration in range(self.num_iterations):
            shape = (*mask.shape[:2], self.num_samples, *mask.shape[2:])
            unit = mean.unsqueeze(2) + deviation.unsqueeze(2) * torch.randn(shape, device=device)
            unit[:, :, 0] = mean
            unit = unit.clamp_(-1.0, 1.0) * mask.unsqueeze(2)
            value = returns(discrete, unit)
            if iteration == 0 and self.num_kept < value.shape[1]:
                kept = value.amax(-1).topk(self.num_kept, -1).indices
                value = value.take_along_dim(kept.unsqueeze(-1), 1)
                unit = unit.take_along_dim(kept[..., None, None, None], 1)
                discrete = discrete.take_along_dim(kept.unsqueeze(-1), 1)
                mask = has_slot[discrete]
            place, weight = elite_weights(value, self.num_elites, self.temperature)
            elites = unit.take_along_dim(place[..., None, None], 2)
            weight = weight[..., None, None]
            mean = (weight * elites).sum(2)
            variance = (weight * (elites - mean.unsqueeze(2)).square()).sum(2)
            deviation = variance.sqrt().clamp(min=self.min_deviation)
        best_value, best = value.amax(-1).max(-1)
        row = torch.arange(num_states, device=device)
        return Found(discrete[row, best, 0], mean[row, best, 0], best_value)
