"""The policy of PETS: it searches for a sequence of actions in the ensemble, and takes the first one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import Bonus, States
from hpamdp.policies.low_level.pets.model import PETSModel
from hpamdp.policies.low_level.pets.options import PETSOptions
from hpamdp.policies.shared.contingent_planning import ContingentSearch
from hpamdp.policies.shared.end_values import EndValues
from hpamdp.policies.shared.exploration import with_exploring_noise
from hpamdp.policies.shared.joint_choice import JointChoice
from hpamdp.policies.shared.known_directions import KnownDirections
from hpamdp.policies.shared.perception import Perception
from hpamdp.policies.shared.planning import (
    PlannedAction,
    Prediction,
    Returns,
    SequenceSearch,
    SequenceStep,
    discounted_return,
)
from hpamdp.policies.shared.planning_policy import PlanningPolicy
from hpamdp.specs import PAMDPSpecs

MEMBER = "member"  # which member an environment follows, int64 [*B]

_CHUNK_ROWS = 8192  # states predicted at once when planning: fits the cache and bounds the memory


class PETSPolicy(PlanningPolicy):
    """Take the first action of a plan.

    When exploring with posterior sampling, plan with the one member that the environment follows.

    The policy acts uniformly at random until the stored steps differ in their rewards or in whether they terminate:
    before, all plans have the same value.

    Attributes:
        bonus: a reward of exploring plans for new states; None for none.
    """

    bonus: Bonus | None = None

    def __init__(
        self,
        model: PETSModel,
        specs: PAMDPSpecs,
        entries: list[int],
        options: PETSOptions,
        perception: Perception,
        end_value: EndValues | None,
    ) -> None:
        super().__init__(specs, options.epsilon, perception)
        own_keys: list[NestedKey] = [keys.IS_DECISION, MEMBER]
        self.in_keys += [key for key in own_keys if key not in self.in_keys]
        self.out_keys += [MEMBER]
        self.options = options
        self.entries = entries
        self.model = model
        self.joint = JointChoice(specs)
        self.search = SequenceSearch(self.joint.parameter_dims, options)
        self.contingent: ContingentSearch | None = None
        if isinstance(perception.memory, KnownDirections) and options.hypotheses > 0:
            contingent = ContingentSearch(self.joint.parameter_dims, options)
            self.contingent = contingent if contingent.search.tries_all else None
        auto = options.posterior_sampling == "auto"
        self.samples_posterior = model.frame.turns if auto else bool(options.posterior_sampling)
        self.precision: torch.dtype = getattr(torch, options.planning_precision)
        self.end_value = end_value

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action, the member `[*B]` and the parameters `[*B, num_parameters]`."""
        return super().forward(td.set(MEMBER, self._members(td)))

    def _members(self, td: TensorDictBase) -> Tensor:
        """Return the members that environments follow, `[*B]`: a random one where an episode or an option begins."""
        shape = td.batch_size
        fresh = torch.randint(self.model.num_members, shape, device=self.is_trained.device)
        held, begins = td.get(MEMBER, None), td.get(keys.IS_DECISION, None)
        if held is None:
            return fresh
        return held if begins is None else torch.where(begins.reshape(shape), fresh, held)

    def first_action(
        self, td: TensorDictBase, observation: Tensor, is_planned: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the first action of each plan, see `PlanningPolicy.first_action`."""
        observation = observation[is_planned]
        member = td.get(MEMBER).flatten()[is_planned] if self._follows_member else None
        state = self.perception(observation[:, self.entries], self.remembered(td, is_planned), has_seen=True)
        planned = self.plan(state, member, self._allowed(observation, mask))
        own = planned.own if is_greedy() else with_exploring_noise(planned.own, self.options.parameter_noise)
        return self.joint.choice(planned.discrete), self.joint.spread(planned.discrete, own)

    @torch.no_grad()
    def value(self, states: States) -> Tensor:
        """Return the expected returns `[N]` of the plans from states, with what their mask allows.

        A greedy policy uses the mean of all members, and `caution`. An exploring policy uses a random member for each
        observation (posterior sampling), or else the mean and `optimism`, so that it tries what members disagree on.
        Before the policy plans, the greedy value assumes the only known reward at every step; the exploring value is
        infinite.
        """
        observation = states.observation
        num = len(observation)
        if not bool(self.is_trained):
            known = self.model.reward_mean[0] * sum(self.options.gamma**h for h in range(self.options.horizon))
            return known.expand(num) if is_greedy() else torch.full_like(observation[:, 0], torch.inf)
        member = torch.randint(self.model.num_members, (num,), device=observation.device)
        allowed = self._allowed(observation, states.action_mask)
        state = self.perception.of_states(states._replace(observation=observation[:, self.entries]))
        return self.plan(state, member if self._follows_member else None, allowed).value

    @property
    def _follows_member(self) -> bool:
        return self.samples_posterior and not is_greedy()

    @property
    def _plan_bonus(self) -> Bonus | None:
        return None if is_greedy() else self.bonus

    def plan(self, state: Tensor, member: Tensor | None = None, allowed: Tensor | None = None) -> PlannedAction:
        """Plan from N states.

        Args:
            state: the features of where the plans begin, `[N, F]`. Without a memory they are the observations.
            member: the member that each plan follows, `[N]`. If None, plans use the mean of all members.
            allowed: the numbered choices that each step may take, bool `[N, horizon, J]`. If None, all.
        """
        memory = self.perception.memory
        if self.contingent is None or not isinstance(memory, KnownDirections):
            return self._plan_as(state.unsqueeze(1), member, allowed, None)
        shows = memory.unknown(state)
        is_open = shows.any(-1)
        parts = []
        for rows in (is_open, ~is_open):
            if not rows.any():
                continue
            own_member = None if member is None else member[rows]
            own_allowed = None if allowed is None else allowed[rows]
            if rows is is_open:
                sampled = memory.hypotheses(state[rows], self.options.hypotheses)
                parts.append(self._plan_as(sampled, own_member, own_allowed, shows[rows]))
            else:
                parts.append(self._plan_as(state[rows].unsqueeze(1), own_member, own_allowed, None))
        order = torch.cat([is_open.nonzero(), (~is_open).nonzero()]).squeeze(1).argsort()
        return PlannedAction(*(torch.cat(each)[order] for each in zip(*parts, strict=True)))

    def _plan_as(
        self, state: Tensor, member: Tensor | None, allowed: Tensor | None, shows: Tensor | None
    ) -> PlannedAction:
        """Plan from states `[N, M, F]` under M hypotheses, as `plan` does.

        `shows` are the actions that show what is not known, bool `[N, J]`; None if all is known.
        """
        num_members = self.model.num_members
        if member is None:
            return self._plan(state.expand(num_members, -1, -1, -1), allowed, shows, is_mean=True)
        # All members at once, each with as many states as the one with the most, some of them zeros.
        is_own = member.unsqueeze(-1) == torch.arange(num_members, device=member.device)
        place = (is_own.cumsum(0) - 1).gather(1, member.unsqueeze(-1)).squeeze(-1)
        num_places = int(place.max()) + 1

        def stacked(part: Tensor, filling: float) -> Tensor:
            whole = part.new_full((num_members, num_places, *part.shape[1:]), filling)
            whole[member, place] = part
            return whole

        allowed = None if allowed is None else stacked(allowed, True)
        shows = None if shows is None else stacked(shows, False)
        planned = self._plan(stacked(state, 0.0), allowed, shows, is_mean=False)
        row = member * num_places + place
        return PlannedAction(*(part[row] for part in planned))

    def _allowed(self, observation: Tensor, action_mask: Tensor | None) -> Tensor | None:
        """Return which numbered choices each step of a plan may take, bool `[N, horizon, J]`. If None, all.

        What the environment will allow in predicted states is unknown, and taken to be everything.
        """
        first = self.specs.allowed(observation, action_mask)
        if first is None:
            return None
        later = self.specs.allowed(observation)
        later = torch.ones_like(first) if later is None else later
        return self.joint.allowed(torch.stack([first] + [later] * (self.options.horizon - 1), 1))

    def _plan(self, state: Tensor, allowed: Tensor | None, shows: Tensor | None, *, is_mean: bool) -> PlannedAction:
        """Plan from states `[E, N, M, F]`: N plans by the mean of all members, or one for each member's state.

        A plan by the mean lets single members choose the sequences to refine, which is several times faster. If new
        states are rewarded, all members choose.
        `allowed` is bool `[N, horizon, J]`, or `[E, N, horizon, J]`; `shows` is bool `[N, J]`, or `[E, N, J]`.
        """
        search = self.search if shows is None or self.contingent is None else self.contingent.search
        num_sequences = min(self.options.num_kept, search.num_sequences) if is_mean else search.num_sequences
        num_rows = state.shape[2] * num_sequences * search.samples_of_a_sequence(is_greedy())
        size = max(1, _CHUNK_ROWS // num_rows)
        parts = []
        for begin in range(0, state.shape[1], size):
            rows = slice(begin, begin + size)
            piece = state[:, rows]
            own_allowed, own_shows = (_of_plans(part, rows, is_mean) for part in (allowed, shows))
            hypotheses = piece.flatten(1, 2)
            # Single members do not know what is new.
            is_rough = is_mean and self._plan_bonus is None
            first_returns = self._returns_of_single_members(hypotheses[0]) if is_rough else None
            returns = self._returns(hypotheses, is_mean)
            if own_shows is None or self.contingent is None:
                num_plans = piece.shape[1] if is_mean else piece.shape[:2].numel()
                part = search(returns, num_plans, state.device, own_allowed, first_returns, is_greedy=is_greedy())
            else:
                num = state.shape[2]
                part = self.contingent(returns, own_shows, num, own_allowed, first_returns, is_greedy=is_greedy())
            parts.append(part if is_mean else PlannedAction(*(each.unflatten(0, piece.shape[:2]) for each in part)))
        joined_parts = PlannedAction(*(torch.cat(each, 0 if is_mean else 1) for each in zip(*parts, strict=True)))
        return joined_parts if is_mean else PlannedAction(*(each.flatten(0, 1) for each in joined_parts))

    def _returns(self, state: Tensor, is_mean: bool) -> Returns:
        """Return a function from sequences to their predicted returns, from states `[E, N, F]`.

        The returns are one for each member and state, or with `is_mean` those of all members together. After each
        imagined step, the memory is that after the predicted observation.
        """
        num_members, num_states = state.shape[:2]
        bonus = self._plan_bonus if is_mean else None

        def for_members(part: Tensor) -> Tensor:
            """Return `[N, ...]` or `[E * N, ...]` as `[E, N, ...]`."""
            return part.expand(num_members, *part.shape) if is_mean else part.unflatten(0, (num_members, num_states))

        def returns(steps: Sequence[SequenceStep]) -> Tensor:
            num_sequences = steps[-1].discrete.shape[1]

            def predictions() -> Iterator[Prediction]:
                # [E, F, N, Q_h, S]: see `joined`
                rows = state.mT[..., None, None].expand(-1, -1, -1, 1, steps[0].own.shape[2])
                for place, step in enumerate(steps):
                    shape = num_states, *step.own.shape[1:3]
                    rows = _each_repeated(rows, shape[1] // rows.shape[-2]).flatten(2)
                    discrete = for_members(step.discrete).unsqueeze(-1).expand(num_members, *shape).flatten(1)
                    own = for_members(step.own).flatten(1, 3)
                    ahead = self.model(rows.mT, discrete, own, self.precision)
                    if bonus is not None:
                        ahead = self._with_bonus(rows.mT, discrete, ahead, bonus)
                    next_rows = ahead.next_state
                    if place < len(steps) - 1 or self.end_value is not None:
                        next_rows = self.perception.imagined(rows.mT, next_rows)
                    rows = next_rows.mT.unflatten(-1, shape)
                    parts = (part.unflatten(1, shape) for part in ahead[1:])
                    yield Prediction(rows, *(_each_repeated(part, num_sequences // shape[1]) for part in parts))

            end_value = None if self.end_value is None else self._end_value_of_joined
            total = discounted_return(predictions(), self.options.gamma, end_value)
            if not is_mean:
                return total.flatten(0, 1)
            weight = -self.options.caution if is_greedy() else self.options.optimism
            return total.mean(0) if weight == 0.0 else total.mean(0) + weight * total.std(0, correction=0)

        return returns

    def _with_bonus(self, state: Tensor, discrete: Tensor, ahead: Prediction, bonus: Bonus) -> Prediction:
        """Return predictions whose rewards, if the step does not terminate, include the bonus of its next state.

        Disagreement is the standard deviation of the members' predicted changes, averaged over the predicted entries.
        It is measured in the canonical frame, in units of the usual change there.

        Args:
            state: `[E, B, F]`, from which each member predicts.
            discrete: the discrete actions, `[E, B]`.
            ahead: what they predict, `[E, B]`.
            bonus: the bonus.
        """
        model = self.model
        if bonus.of is not None:
            return ahead._replace(continuing=ahead.continuing + bonus.weight * bonus.of(ahead.next_state.float()))
        change = model.scaled_change(state, discrete, ahead.next_state)
        spread = (change.std(0, correction=0) * model.is_predicted).sum(-1) / model.is_predicted.sum().clamp(min=1.0)
        return ahead._replace(continuing=ahead.continuing + bonus.weight * spread)

    def _end_value_of_joined(self, rows: Tensor) -> Tensor:
        """Return the values `[E, N, Q, S]` of states `[E, F, N, Q, S]` at the end of a plan."""
        assert self.end_value is not None
        return self.end_value(rows.movedim(1, -1))

    def _returns_of_single_members(self, state: Tensor) -> Returns:
        """Return a function from sequences to the returns that a single member predicts, from states `[N, *]`.

        Each member predicts for an equal number of the states.
        """
        num_members, num_states = self.model.num_members, len(state)
        num_places = -(-num_states // num_members)

        def padded(part: Tensor) -> Tensor:
            last = part[-1:].expand(num_members * num_places - num_states, *part.shape[1:])
            return torch.cat([part, last])

        returns = self._returns(padded(state).unflatten(0, (num_members, num_places)), is_mean=False)
        return lambda steps: returns([SequenceStep(*map(padded, step)) for step in steps])[:num_states]


def _of_plans(whole: Tensor | None, rows: slice, is_mean: bool) -> Tensor | None:
    """Return the rows of some plans, of `[N, *]` in plans by the mean of all members, else of `[E, N, *]`."""
    if whole is None:
        return None
    return whole[rows] if is_mean else whole[:, rows].flatten(0, 1)


def _each_repeated(rows: Tensor, times: int) -> Tensor:
    """Return `[..., Q, S]` with each of Q repeated, `[..., Q * times, S]`."""
    return rows if times == 1 else rows.unsqueeze(-2).expand(*rows.shape[:-1], times, -1).flatten(-3, -2)
