"""Planning in a learned model: predictions of a step, returns of plans, and a search over sequences of actions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hpamdp.policies.masks import random_choice
from hpamdp.policies.shared.options import SequenceSearchOptions

# Of a sequence with a forbidden action: below all returns, and finite, so that the weights of the elites are numbers.
_FORBIDDEN_RETURN = -1e30


class Prediction(NamedTuple):
    """What a model predicts for one step; E is the number of its members, where they differ."""

    next_state: Tensor  # [B, observation_dim] or [E, B, observation_dim], if the step does not terminate
    continuing: Tensor  # [E, B] reward if the step does not terminate
    terminating: Tensor  # [E, B] reward if it does
    logit: Tensor  # [E, B] of termination


def discounted_return(
    steps: Iterable[Prediction], gamma: float, end_value: Callable[[Tensor], Tensor] | None = None
) -> Tensor:
    """Return the discounted sum `[E, B]` of the expected rewards of consecutive steps.

    A step's reward is weighted by the probability that no step before it terminates.

    Args:
        steps: what is predicted of them.
        gamma: discount of a step.
        end_value: maps the last step's `next_state`, whatever its shape, to what follows it, `[B]` or `[E, B]`, which
            is weighted in the same way. If None, nothing.
    """
    total: Tensor | float = 0.0
    survival: Tensor | float = 1.0
    discount, state = 1.0, None
    for step in steps:
        ends = step.logit.float().sigmoid()
        reward = ends * step.terminating + (1.0 - ends) * step.continuing
        total = total + discount * survival * reward.float()
        survival = survival * (1.0 - ends)
        discount, state = discount * gamma, step.next_state
    if end_value is not None and state is not None:
        total = total + discount * survival * end_value(state.float())
    assert isinstance(total, Tensor)
    return total


def elite_weights(returns: Tensor, num_elites: int, temperature: Tensor) -> tuple[Tensor, Tensor]:
    """Return the indices and the weights of the best candidates, `[*B, num_elites]` each.

    The weights are exp(return / temperature), normalised.

    Args:
        returns: of the candidates, `[*B, S]`.
        num_elites: how many of them are the best ones.
        temperature: positive, of a shape that broadcasts with `returns`.
    """
    best, place = returns.topk(num_elites, -1)
    return place, ((best - best[..., :1]) / temperature).softmax(-1)


def absolute_temperature(temperature: float, returns: Tensor, is_allowed: Tensor | None = None) -> Tensor:
    """Return a plan's temperature in units of returns, `[N]`, positive.

    Args:
        temperature: relative to the standard deviation of the returns.
        returns: of its first samples, `[N, ..., S]`.
        is_allowed: the sequences that count, bool `[N, ...]`. If None, all.
    """
    if is_allowed is None:
        spread = returns.flatten(1).std(-1, correction=0)
    else:
        weight = is_allowed.unsqueeze(-1).expand_as(returns).flatten(1).to(returns.dtype)
        weight = weight / weight.sum(-1, keepdim=True).clamp(min=1.0)
        mean = (weight * returns.flatten(1)).sum(-1, keepdim=True)
        spread = (weight * (returns.flatten(1) - mean).square()).sum(-1).sqrt()
    return (temperature * spread).clamp(min=torch.finfo(spread.dtype).tiny)


class SequenceStep(NamedTuple):
    """One step of many sequences of parameterised actions, `Q_h` of them for each of N states.

    Sequences that begin alike may share their first steps: with Q sequences in all, sequence q takes number
    `q // (Q / Q_h)` of a step.
    """

    discrete: Tensor  # int64 [N, Q_h]
    own: Tensor  # [N, Q_h, S, D] samples of the discrete action's parameters in [-1, 1], 0 past its own


Returns = Callable[[Sequence[SequenceStep]], Tensor]


class PlannedAction(NamedTuple):
    """The first step of the best sequence for each of N states, and the sequence's predicted return."""

    discrete: Tensor  # int64 [N]
    own: Tensor  # [N, D] in [-1, 1]: parameters of the discrete action, 0 past its own
    value: Tensor  # [N]


class SequenceSearch:
    """Find good sequences of parameterised actions: each sequence of discrete actions has Gaussians of its own.

    At first, every sequence of discrete actions is tried with a few samples of the parameters, spread evenly over
    their bounds. If there are more than `max_sequences`, so many random sequences are tried, in which the first actions
    occur equally often. Then the best `num_kept` sequences are refined. Each later iteration refines half as many.

    Samples come from a Gaussian for every parameter, whose mean and deviation are those of the elites of the iteration
    before. Its deviation has a lower bound, which falls from iteration to iteration. Where a return is a cliff, such as
    at the shortest way into a target, the elites' own deviation shrinks before the edge is found. The best sample so
    far is among the next samples, and the best of the last samples is the plan.

    Cross-entropy planning over mixed actions has a categorical distribution for each step instead. There, sequences
    whose parameters should differ share one Gaussian.

    Samples are stratified, one for each of as many equally likely intervals, as in a Latin hypercube: McKay, Beckman
    and Conover 1979, *Technometrics* 21(2).

    Args:
        parameter_dims: number of parameters of each discrete action.
        options: the settings; single ones may be given by their names.
    """

    def __init__(
        self, parameter_dims: tuple[int, ...], options: SequenceSearchOptions | None = None, **settings: Any
    ) -> None:
        self.options: SequenceSearchOptions = SequenceSearchOptions.of(options, settings)
        self.num_discrete = len(parameter_dims)
        own = torch.arange(max(parameter_dims)) < torch.tensor(parameter_dims).unsqueeze(-1)
        self.has_slot = own.float()  # [num_discrete, D]

    @property
    def tries_all(self) -> bool:
        """Whether the first iteration tries every sequence of discrete actions."""
        return self.num_discrete**self.options.horizon <= self.options.max_sequences

    @property
    def num_sequences(self) -> int:
        """How many sequences the first iteration tries."""
        return min(self.options.max_sequences, self.num_discrete**self.options.horizon)

    def sequences(self, num_states: int, device: torch.device, allowed: Tensor | None = None) -> list[Tensor]:
        """Return the discrete actions of the first iteration's sequences, int64 `[N, Q_h]` for each step.

        If all are tried, there is one first step for each discrete action, one second step for each two, and so on.
        Forbidden actions are among them. Otherwise random allowed actions take the place of forbidden ones.
        """
        if self.tries_all:
            each = torch.arange(self.num_discrete, device=device)
            return [each.repeat(self.num_discrete**h).expand(num_states, -1) for h in range(self.options.horizon)]
        shape = self.options.horizon, num_states, self.num_sequences
        sampled = torch.randint(self.num_discrete, shape, device=device)
        begin = torch.randint(self.num_discrete, (num_states, 1), device=device)
        sampled[0] = (begin + torch.arange(self.num_sequences, device=device)) % self.num_discrete
        if allowed is not None:
            mask = allowed.movedim(1, 0).unsqueeze(2).expand(-1, -1, self.num_sequences, -1)
            others = random_choice(sampled.shape, self.num_discrete, mask, device)
            sampled = torch.where(mask.gather(-1, sampled.unsqueeze(-1)).squeeze(-1), sampled, others)
        return list(sampled)

    def _are_allowed(self, steps: Sequence[SequenceStep], allowed: Tensor) -> Tensor:
        """Return which sequences take allowed actions alone, bool `[N, Q]`."""
        is_allowed = torch.ones(len(allowed), self.num_sequences, dtype=torch.bool, device=allowed.device)
        for h, step in enumerate(steps):
            is_step_allowed = allowed[:, h].gather(1, step.discrete)
            is_allowed &= is_step_allowed.repeat_interleave(self.num_sequences // step.discrete.shape[1], 1)
        return is_allowed

    def samples_of_a_sequence(self, is_greedy: bool) -> int:
        """Return how many samples of the parameters each sequence has in an iteration."""
        return self.options.greedy_samples if is_greedy else self.options.num_samples

    def __call__(
        self,
        returns: Returns,
        num_states: int,
        device: torch.device,
        allowed: Tensor | None = None,
        first_returns: Returns | None = None,
        *,
        is_greedy: bool = False,
    ) -> PlannedAction:
        """Search for `num_states` states at once.

        Args:
            returns: maps the steps of Q sequences to their returns `[N, Q, S]`.
            num_states: N.
            device: where to search.
            allowed: the discrete actions that each step may take, bool `[N, horizon, num_discrete]`. If None, all.
            first_returns: the same as `returns`, but rougher and faster, for the first iteration, which only chooses
                what is refined. If None, `returns`.
            is_greedy: whether to try `greedy_samples` of the parameters.
        """
        num_samples = self.samples_of_a_sequence(is_greedy)
        has_slot = self.has_slot.to(device)
        steps = []
        for number in self.sequences(num_states, device, allowed):
            mask = has_slot[number].unsqueeze(2)
            shape = *number.shape, num_samples, has_slot.shape[-1]
            steps.append(SequenceStep(number, (2.0 * stratified(shape, device) - 1.0) * mask))
        is_last = self.options.num_iterations == 1
        value = returns(steps) if first_returns is None or is_last else first_returns(steps)
        is_allowed = None if allowed is None else self._are_allowed(steps, allowed)
        temperature = absolute_temperature(self.options.temperature, value, is_allowed)
        value = without_forbidden(value, is_allowed)
        kept = self._best_sequences(value, self.options.num_kept)
        value = value.take_along_dim(kept.unsqueeze(-1), 1)
        is_allowed = None if is_allowed is None else is_allowed.gather(1, kept)
        # From here on [N, Q, H] and [N, Q, S, H, D], with Q sequences kept.
        prefixes = [kept // (self.num_sequences // step.discrete.shape[1]) for step in steps]
        parts = list(zip(steps, prefixes, strict=True))
        discrete = torch.stack([step.discrete.gather(1, prefix) for step, prefix in parts], -1)
        row = torch.arange(num_states, device=device)
        unit_parameters = torch.stack([step.own[row.unsqueeze(-1), prefix] for step, prefix in parts], -2)
        for refinement in range(self.options.num_iterations - 1):
            if refinement > 0:
                kept = self._best_sequences(value, self.options.num_kept >> refinement)
                value = value.take_along_dim(kept.unsqueeze(-1), 1)
                is_allowed = None if is_allowed is None else is_allowed.gather(1, kept)
                discrete = discrete.take_along_dim(kept.unsqueeze(-1), 1)
                unit_parameters = unit_parameters.take_along_dim(kept[..., None, None, None], 1)
            elites = elite_weights(value, self.options.num_elites, temperature[:, None, None])
            mean, deviation = moments(unit_parameters, *elites)
            deviation = deviation.clamp(min=self.lower_bound(refinement))
            best = _best_samples(value, unit_parameters)
            normal = torch.special.ndtri(stratified(unit_parameters.shape, device))
            unit_parameters = mean.unsqueeze(2) + deviation.unsqueeze(2) * normal
            unit_parameters[:, :, -1] = mean
            unit_parameters[:, :, 0] = best
            unit_parameters = unit_parameters.clamp_(-1.0, 1.0) * has_slot[discrete].unsqueeze(2)
            value = returns(
                [SequenceStep(discrete[..., h], unit_parameters[..., h, :]) for h in range(self.options.horizon)]
            )
            value = without_forbidden(value, is_allowed)
        best_value, place = value.amax(-1).max(-1)
        return PlannedAction(discrete[row, place, 0], _best_samples(value, unit_parameters)[row, place, 0], best_value)

    @staticmethod
    def _best_sequences(value: Tensor, num: int) -> Tensor:
        """Return the places `[N, num]` of the sequences with the best samples, of returns `[N, Q, S]`; at least one."""
        return value.amax(-1).topk(max(1, min(num, value.shape[1])), -1).indices

    def lower_bound(self, refinement: int) -> float:
        """Return the smallest deviation in a refinement, counted from 0."""
        fraction = refinement / max(1, self.options.num_iterations - 2)
        return self.options.first_min_deviation ** (1.0 - fraction) * self.options.min_deviation**fraction


def moments(own: Tensor, place: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and deviation `[*B, H, D]` of samples `[*B, S, H, D]` at places with weights, `[*B, num_elites]`."""
    elites, weight = own.take_along_dim(place[..., None, None], -3), weight[..., None, None]
    mean = (weight * elites).sum(-3)
    return mean, (weight * (elites - mean.unsqueeze(-3)).square()).sum(-3).sqrt()


def _best_samples(value: Tensor, unit_parameters: Tensor) -> Tensor:
    """Return each sequence's best sample `[N, Q, H, D]`, of returns `[N, Q, S]` of `[N, Q, S, H, D]`."""
    return unit_parameters.take_along_dim(value.argmax(-1)[..., None, None, None], 2).squeeze(2)


def without_forbidden(value: Tensor, is_allowed: Tensor | None) -> Tensor:
    """Return the returns `[N, Q, S]` with those of forbidden sequences, bool `[N, Q]`, below all others."""
    return value if is_allowed is None else value.masked_fill(~is_allowed.unsqueeze(-1), _FORBIDDEN_RETURN)


def stratified(shape: Sequence[int], device: torch.device) -> Tensor:
    """Return uniform samples in (0, 1), `[N, Q, S, ...]`: for each place, one in each of S equal intervals.

    The order of the intervals is the same for all N, since sorting takes longer than all else.
    """
    stratum = torch.rand(shape[1:], device=device, dtype=torch.float32).argsort(1)
    return ((stratum + torch.rand(shape, device=device, dtype=torch.float32)) / shape[2]).clamp_(1e-6, 1.0 - 1e-6)
