"""Plans whose first action may show something, by which the rest is chosen.

In a plan that is one sequence of actions, finding out has no value. Here each state comes with M hypotheses of what is
not known. The first action is the same under all of them. If it shows what is not known, what follows is chosen for
each hypothesis by itself; otherwise it is the same, too. So the search expects to know the truth after an action that
shows something (QMDP: Littman, Cassandra and Kaelbling 1995, *Learning policies for partially observable
environments*). Planning for each sampled hypothesis with hindsight: Chong, Givan and Chang 2000, *A framework for
simulation-based network control via hindsight optimization*.

Differs from the sources: continuous parameters are searched for, and actions that show nothing gain nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.policies.shared.options import SequenceSearchOptions
from hpamdp.policies.shared.planning import (
    PlannedAction,
    Returns,
    SequenceSearch,
    SequenceStep,
    absolute_temperature,
    elite_weights,
    moments,
    stratified,
    without_forbidden,
)


class _Candidates(NamedTuple):
    """A first actions, each with C sequences that begin with it, for N states under M hypotheses."""

    discrete: Tensor  # int64 [N, M, A, C, H]
    own: Tensor  # [N, M, A, C, S, H, D] samples of the parameters in [-1, 1]
    value: Tensor  # [N, M, A, C, S]
    shows: Tensor  # bool [N, A]

    def of_first(self) -> Tensor:
        """Return the value of each sample of the first actions, `[N, A, S]`: the mean of the best that follows."""
        return self.value.amax(3).mean(1)


class ContingentSearch:
    """Search for the best first action of states under hypotheses, with what follows under each of them.

    The search is that of `SequenceSearch`, with these differences. Sequences have one step more, because the first one
    may be needed to find out. All discrete first actions are refined in the second iteration, and half as many in each
    one after it. The Gaussian of a first action's parameters is that of all hypotheses; what follows has one for each.

    Args:
        parameter_dims: number of parameters of each discrete action.
        options: the settings.

    Attributes:
        search: finds the sequences. All of them must be tried, see `SequenceSearch.tries_all`.
    """

    def __init__(self, parameter_dims: tuple[int, ...], options: SequenceSearchOptions) -> None:
        self.options = options.model_copy(update={"horizon": options.horizon + 1})
        self.search = SequenceSearch(parameter_dims, self.options)

    def __call__(
        self,
        returns: Returns,
        shows: Tensor,
        num_hypotheses: int,
        allowed: Tensor | None = None,
        first_returns: Returns | None = None,
        *,
        is_greedy: bool = False,
    ) -> PlannedAction:
        """Search for N states at once, each under M hypotheses.

        Args:
            returns: maps the steps of Q sequences to their returns `[N * M, Q, S]`.
            shows: the discrete actions that show what is not known, bool `[N, num_discrete]`.
            num_hypotheses: M.
            allowed: the discrete actions that each step may take, bool `[N, horizon, num_discrete]`. If None, all. The
                further step may take what the last one may.
            first_returns: the same as `returns`, but rougher and faster, for the first iteration.
            is_greedy: whether to try `greedy_samples` of the parameters.
        """
        if allowed is not None:
            allowed = torch.cat([allowed, allowed[:, -1:]], 1)
        first_returns = returns if first_returns is None or self.options.num_iterations == 1 else first_returns
        found = self._first(shows, num_hypotheses, is_greedy)
        is_allowed = None if allowed is None else _are_allowed(found.discrete, allowed)
        value = self._values(found, first_returns)
        temperature = absolute_temperature(self.options.temperature, value, is_allowed)
        found = found._replace(value=without_forbidden(value, is_allowed))
        for refinement in range(self.options.num_iterations - 1):
            if refinement > 0:
                found = _with_best_first(found)
            found = _with_best_following(found, self.options.num_kept >> refinement)
            own = self._refined(found, temperature, self.search.lower_bound(refinement))
            found = found._replace(own=own)
            is_allowed = None if allowed is None else _are_allowed(found.discrete, allowed)
            found = found._replace(value=without_forbidden(self._values(found, returns), is_allowed))
        best_value, place = found.of_first().flatten(1).max(-1)
        row, num_samples = torch.arange(len(shows), device=shows.device), found.value.shape[-1]
        first, sample = place // num_samples, place % num_samples
        return PlannedAction(found.discrete[row, 0, first, 0, 0], found.own[row, 0, first, 0, sample, 0], best_value)

    def _first(self, shows: Tensor, num_hypotheses: int, is_greedy: bool) -> _Candidates:
        """Return all sequences, with samples of the parameters that all hypotheses share, and no values yet."""
        num_states, num_discrete = shows.shape
        steps = self.search.sequences(num_states, shows.device)
        num_sequences = steps[-1].shape[1]
        discrete = torch.stack([step.repeat_interleave(num_sequences // step.shape[1], 1) for step in steps], -1)
        has_slot = self.search.has_slot.to(shows.device)
        parts = []
        for step in steps:
            shape = num_states, step.shape[1], self.search.samples_of_a_sequence(is_greedy), has_slot.shape[-1]
            own = 2.0 * stratified(shape, shows.device) - 1.0
            parts.append(own.repeat_interleave(num_sequences // step.shape[1], 1))
        own = torch.stack(parts, -2) * has_slot[discrete].unsqueeze(2)
        discrete, own = (part.unflatten(1, (num_discrete, -1)).unsqueeze(1) for part in (discrete, own))
        discrete = discrete.expand(-1, num_hypotheses, -1, -1, -1)
        return _Candidates(discrete, own.expand(-1, num_hypotheses, *own.shape[2:]), own.new_empty(0), shows)

    def _values(self, found: _Candidates, returns: Returns) -> Tensor:
        """Return the values of candidates: the mean of all hypotheses where the first action shows nothing."""
        discrete, own = (part.flatten(2, 3).flatten(0, 1) for part in (found.discrete, found.own))
        value = returns([SequenceStep(discrete[..., h], own[..., h, :]) for h in range(self.options.horizon)])
        value = value.reshape(found.own.shape[:-2])
        return torch.where(found.shows[:, None, :, None, None], value, value.mean(1, keepdim=True))

    def _refined(self, found: _Candidates, temperature: Tensor, lower_bound: float) -> Tensor:
        """Return new samples of the parameters, `[N, M, A, C, S, H, D]`. The draws are those of all hypotheses."""
        own, of_first, num = found.own, found.of_first(), self.options.num_elites
        first = moments(own[:, 0, :, 0, :, :1], *elite_weights(of_first, num, temperature[:, None, None]))
        # What follows should be good after first actions that are good.
        both = found.value + of_first[:, None, :, None]
        mean, deviation = moments(own, *elite_weights(both, num, temperature[:, None, None, None, None]))
        for whole, part in zip((mean, deviation), first, strict=True):
            whole[..., :1, :] = part[:, None, :, None]
        shape = own.shape[0], own.shape[2] * own.shape[3], *own.shape[4:]
        normal = torch.special.ndtri(stratified(shape, own.device)).unflatten(1, own.shape[2:4]).unsqueeze(1)
        normal[..., 0, :] = normal[:, :, :, :1, :, 0].clone()
        best = of_first.argmax(-1)[:, None, :, None, None, None, None]
        samples = mean.unsqueeze(4) + deviation.clamp(min=lower_bound).unsqueeze(4) * normal
        samples[:, :, :, :, -1] = mean
        samples[:, :, :, :, 0] = own.take_along_dim(best, 4).squeeze(4)
        return samples.clamp_(-1.0, 1.0) * self.search.has_slot.to(own.device)[found.discrete].unsqueeze(4)


def _are_allowed(discrete: Tensor, allowed: Tensor) -> Tensor:
    """Return which sequences of discrete actions `[N, M, A, C, H]` have allowed steps only, bool `[N, M, A, C]`.

    Args:
        discrete: the sequences.
        allowed: the discrete actions that each step may take, bool `[N, H, num_discrete]`.
    """
    of_steps = allowed[:, None, None, None].expand(*discrete.shape, -1)
    return of_steps.gather(-1, discrete.unsqueeze(-1)).squeeze(-1).all(-1)


def _with_best_first(found: _Candidates) -> _Candidates:
    """Return the better half of the first actions."""
    place = found.of_first().amax(-1).topk(-(-found.shows.shape[1] // 2), -1).indices
    return _chosen(found, place[:, None, :, None], 2)._replace(shows=found.shows.gather(1, place))


def _with_best_following(found: _Candidates, num: int) -> _Candidates:
    """Return the best sequences of each first action under each hypothesis, at least one."""
    num = max(1, min(num, found.value.shape[3]))
    return _chosen(found, found.value.amax(-1).topk(num, -1).indices, 3)


def _chosen(found: _Candidates, place: Tensor, dim: int) -> _Candidates:
    """Return the candidates at places, which are given for the first four dimensions."""
    return found._replace(
        discrete=found.discrete.take_along_dim(place[..., None], dim),
        own=found.own.take_along_dim(place[..., None, None, None], dim),
        value=found.value.take_along_dim(place[..., None], dim),
    )
