"""The whole agent: a selector over one learner for each option, or over a single learner that observes the option."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.envs.utils import ExplorationType

from hpamdp import keys
from hpamdp.acting import acting, is_greedy
from hpamdp.policies.base import Learner, Level, Selector, States, finished_decisions
from hpamdp.policies.exploration.base import Exploration
from hpamdp.policies.masks import allowed_or_first
from hpamdp.policies.option_lengths import OptionLengths, PairSelector
from hpamdp.policies.practice import Practice
from hpamdp.specs import PAMDPSpecs

FOR_TRAINING = "explorations."
"""Prefix of an agent's parameters and buffers that are parts of explorations.

A part that also acts, such as a wrapped policy, is part of `router`, too, and has a second name there.
"""


def with_option(rows: TensorDictBase, num_options: int) -> TensorDictBase:
    """Return a shallow copy whose observations, also those under `next`, end in the one-hot option."""
    rows = rows.copy()
    one_hot = F.one_hot(rows.get(keys.OPTION), num_options).float()
    for name in (keys.OBSERVATION, ("next", keys.OBSERVATION)):
        observation = rows.get(name, None)
        if observation is not None:
            rows.set(name, torch.cat([observation, one_hot], -1))
    return rows


def ended_with_trips(batch: TensorDictBase) -> TensorDictBase:
    """Return a shallow copy of steps `[*B]` in which a trip's last step is `done` and `terminated`.

    Values that are learned from these steps count no reward of later trips. Memories go on, since they begin where
    `is_decision` or `episode_steps` says so.
    """
    trip_ended = batch.get(("next", keys.TRIP_ENDED))
    batch = batch.copy()
    for name in (keys.DONE, keys.TERMINATED):
        batch.set(("next", name), batch.get(("next", name)) | trip_ended)
    return batch


class OptionRouter(TensorDictModuleBase):
    """The low level's policy: in each environment, the policy of the held option's learner acts.

    Keys that a learner's policy both reads and writes are its state. They stay in the tensordict from step to step, and
    are missing before the first step.

    Args:
        learners: one for each option, or a single one.
        specs: of the problem as the environment states it.
        is_shared: whether the single learner observes the option.
        explorations: the exploration beside each learner; empty if there is none.

    Attributes:
        state_keys: the keys of the policies' state.
    """

    def __init__(
        self,
        learners: Sequence[Learner],
        specs: PAMDPSpecs,
        is_shared: bool,
        explorations: Sequence[Exploration] = (),
    ) -> None:
        super().__init__()
        policies = [learner.policy for learner in learners]
        if explorations:
            policies = [each.acting_policy(learner) for each, learner in zip(explorations, learners, strict=True)]
        self.policies = nn.ModuleList(policies)
        self.specs = specs
        self.is_shared = is_shared
        # Learners of several classes may write keys of their own.
        self._own_out_keys = [list(policy.out_keys) for policy in policies]
        self.out_keys = list(dict.fromkeys(key for own_keys in self._own_out_keys for key in own_keys))
        in_keys = {key for policy in policies for key in policy.in_keys}
        self.state_keys = [key for key in self.out_keys if key in in_keys]
        given = {
            keys.ACTION_MASK: specs.has_action_mask,
            keys.PAIR_MASK: specs.has_pair_mask,
            keys.PARAMETER_LOW: specs.has_parameter_bounds,
            keys.PARAMETER_HIGH: specs.has_parameter_bounds,
            keys.OPTION: specs.num_options > 0,
        }
        self.in_keys = [*in_keys, *(key for key, is_given in given.items() if is_given)]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the action leaves and the other `out_keys` of the learners' policies."""
        if self.is_shared:
            acted = self.policies[0](with_option(self._seen(td), self.specs.num_options))
            return td.update(acted.select(*self.out_keys))
        if len(self.policies) == 1:
            return self.policies[0](td)
        option = td.get(keys.OPTION)
        seen = self._seen(td)
        for i, policy in enumerate(self.policies):
            rows = option == i
            if not rows.any():
                continue
            acted = policy(seen[rows])
            for key in self._own_out_keys[i]:
                value = acted.get(key)
                written = td.get(key, None)
                if written is None:
                    written = value.new_zeros(*td.batch_size, *value.shape[1:])
                written = written.clone()
                written[rows] = value
                td.set(key, written)
        for policy, own_keys in zip(self.policies, self._own_out_keys, strict=True):
            missing = [key for key in own_keys if td.get(key, None) is None]
            if missing:
                self._fill(td, policy, missing)
        return td

    def _fill(self, td: TensorDictBase, policy: nn.Module, missing: Sequence[NestedKey]) -> None:
        """Write zeros under the keys of a policy that acts in no environment, so that all steps have the same keys."""
        with torch.random.fork_rng():
            acted = policy(self._seen(td).reshape(-1)[:1])
        for key in missing:
            value = acted.get(key)
            td.set(key, value.new_zeros(*td.batch_size, *value.shape[1:]))

    def _seen(self, td: TensorDictBase) -> TensorDictBase:
        """Return the entries that the policies read, without missing ones."""
        return td.select(*self.in_keys, strict=False)


class OptionValues(nn.Module):
    """The learners' values of each option.

    It is a module, so that the learners' weights reach the selector's copies in other processes.

    Args:
        learners: one for each option, or a single one that observes the option.
        num_options: how many options there are.

    Attributes:
        memory_key: key of the learners' memory of the episode, on which their values depend. None if they have no
            memory, or one that begins anew with each option.
    """

    def __init__(self, learners: Sequence[Learner], num_options: int) -> None:
        super().__init__()
        self.learners = cast("Sequence[Learner]", nn.ModuleList(learners))
        self.num_options = num_options
        memory_keys = {each.memory_key if each.memory_lasts_an_episode else None for each in learners}
        self.memory_key = memory_keys.pop() if len(memory_keys) == 1 else None

    @torch.no_grad()
    def forward(self, states: States) -> Tensor:
        """Return the values `[N, num_options]` of states `[N]`.

        While exploring, an option's value is infinite if its learner has made no update yet.
        """
        if len(self.learners) == self.num_options:
            return torch.stack([_exploring_value(each, states) for each in self.learners], -1)
        (learner,) = self.learners
        observation, values = states.observation, []
        for one_hot in torch.eye(self.num_options, device=observation.device, dtype=torch.float32):
            seen = torch.cat([observation, one_hot.expand(observation.shape[0], -1)], -1)
            values.append(_exploring_value(learner, states._replace(observation=seen)))
        return torch.stack(values, -1)


def _exploring_value(learner: Learner, states: States) -> Tensor:
    """Return a learner's values `[N]` of states `[N]`; infinite if exploring before its first update."""
    if not is_greedy() and learner.is_untrained():
        return torch.full_like(states.observation[:, 0], torch.inf, dtype=torch.float32)
    return learner.value(states)


class HeldOption(TensorDictModuleBase):
    """The same option in every environment at every step, or the first allowed option if it is forbidden.

    Args:
        option: its number.
        length: the length to write with it; None if lengths are not chosen.
    """

    def __init__(self, option: int, length: int | None = None) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.OPTION, *([] if length is None else [keys.OPTION_LENGTH])]
        self.option = option
        self.length = length

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write `option` int64 `[*B]`, and `option_length` if there is one."""
        option = torch.full(td.batch_size, self.option, device=td.get(keys.OBSERVATION).device)
        if self.length is not None:
            td.set(keys.OPTION_LENGTH, torch.full_like(option, self.length))
        mask = td.get(keys.OPTION_MASK, None)
        return td.set(keys.OPTION, option if mask is None else allowed_or_first(option, mask))


def _at_decision(states: TensorDictBase) -> TensorDictBase:
    """Return a shallow copy of states `[N]` in which a decision is due; episodes that were truncated there go on."""
    is_decision = torch.ones(len(states), 1, dtype=torch.bool, device=states.get(keys.OBSERVATION).device)
    states = states.copy().set(keys.IS_DECISION, is_decision)
    return states.set(keys.DONE, states.get(keys.TERMINATED)) if keys.DONE in states.keys() else states


class AgentNextOptions:
    """The `NextOptions` of an agent: its selector chooses them, and its learners give their values.

    Args:
        selector: chooses the options.
        learners: one for each option, or a single one that observes the option.
        num_options: how many options there are.
        is_shared: whether the single learner observes the option.
        pairs: the pairs of options and lengths, if the selector chooses lengths.
    """

    def __init__(
        self,
        selector: Selector,
        learners: Iterable[Learner],
        num_options: int,
        is_shared: bool,
        pairs: OptionLengths | None = None,
    ) -> None:
        self.selector = selector
        self.learners = list(learners)
        self.num_options = num_options
        self.is_shared = is_shared
        self.pairs = pairs
        self.sees_observation_alone = {*selector.in_keys} <= {keys.OBSERVATION, keys.IS_DECISION}

    @torch.no_grad()
    def value(self, states: States, option: Tensor) -> Tensor:
        """Return the values `[N]` of states under the options chosen there, see `NextOptions.value`."""
        if self.is_shared:
            one_hot = F.one_hot(option, self.num_options).to(torch.float32)
            seen = torch.cat([self._without_option(states.observation), one_hot], -1)
            return self.learners[0].value(states._replace(observation=seen), is_target=True)
        value = torch.zeros(len(option), device=option.device, dtype=torch.float32)
        for i, learner in enumerate(self.learners):
            rows = option == i
            if rows.any():
                value[rows] = learner.value(states.at(rows).for_memory(learner.memory_key), is_target=True)
        return value

    @property
    def decides_ends(self) -> bool:
        """Whether the selector decides where options end."""
        return self.selector.decides_ends

    @torch.no_grad()
    def choose(self, observation: Tensor, option: Tensor, held: Tensor) -> Tensor:
        """Return the selector's greedy options `[N]`, or the given ones if it needs more than the observation."""
        if not self.sees_observation_alone:
            return option
        seen = {keys.OBSERVATION: self._without_option(observation)}
        return self.greedy(TensorDict(seen, [len(observation)]), held)

    @torch.no_grad()
    def probabilities(self, observation: Tensor) -> Tensor | None:
        """Return the probabilities of the options `[N, num_options]`, see `NextOptions.probabilities`."""
        if not self.sees_observation_alone:
            return None
        seen = {keys.OBSERVATION: self._without_option(observation)}
        return self._probabilities(TensorDict(seen, [len(observation)]))

    def _probabilities(self, td: TensorDictBase) -> Tensor | None:
        """Return the probabilities of the options `[N, num_options]` in what the selector reads of states, or None."""
        if self.decides_ends:
            return None
        td = _at_decision(td)
        if self.pairs is None:
            return self.selector.option_probabilities(td)
        probabilities = self.selector.option_probabilities(self.pairs.with_pairs(td))
        return None if probabilities is None else probabilities.unflatten(-1, (self.num_options, -1)).sum(-1)

    @torch.no_grad()
    def greedy(self, td: TensorDictBase, held: Tensor) -> Tensor:
        """Return the selector's greedy options `[N]`; a held option goes on if the selector decides so.

        Args:
            td: the entries that the selector reads of the states `[N]`, without `is_decision`.
            held: the options before, `[N]`.
        """
        td = _at_decision(td).set(keys.OPTION, held)
        with acting(ExplorationType.DETERMINISTIC):
            if self.pairs is not None:
                return self.pairs.split(self.selector.select(self.pairs.with_pairs(td)))[0]
            option = self.selector.select(td)
            return torch.where(self.selector.ends(td), option, held) if self.decides_ends else option

    def with_ends(self, batch: TensorDictBase) -> TensorDictBase:
        """Return a shallow copy of a batch `[*B, T]` in which the selector's decisions mark the ends of options.

        If the selector does not decide on ends, the batch is returned as it is. Otherwise it decides one step later, so
        the next batch will show whether an option ends with the last step. Until then learners take it as ended
        (`option_ended`), possibly followed by itself. The selector does not (`is_decision`), and hears of it with the
        next batch (`with_steps_before`).
        """
        if not self.decides_ends:
            return batch
        done = batch.get(("next", keys.DONE))
        is_ended = batch.get(keys.IS_DECISION).roll(-1, -2) & ~done
        is_ended[..., -1, :] = False
        batch = batch.copy()
        batch.set(("next", keys.IS_DECISION), is_ended | done)
        # If the last state of an episode leaves the held option no action, it ended, too, and another one follows.
        is_ended = is_ended | (batch.get(("next", keys.OPTION_ENDED)) & done)
        is_ended[..., -1, :] = True
        return batch.set(("next", keys.OPTION_ENDED), is_ended)

    def with_steps_before(self, batch: TensorDictBase) -> TensorDictBase:
        """Return a batch `[*B, T]` behind the steps before it, `[*B, T + 1]`, for a selector that decides on ends.

        The batch shows whether an option ended with the step before it. Two things are known of this step: the choice
        that was held, and what followed, which is the first root of the batch. All steps get these entries only.
        """
        root = batch[..., :1]
        after = root.select(*batch.get("next").keys(True, True), strict=False)
        # Where an episode begins, the episode before it was reported as finished, or was given up.
        goes_on = root.get(keys.EPISODE_STEPS) > 0
        after.set(keys.IS_DECISION, root.get(keys.IS_DECISION) & goes_on)
        before = root.get(keys.HELD).copy().set("next", after)
        return torch.cat([before, batch.select(*before.keys(True, True))], -1)

    def with_next_option(self, batch: TensorDictBase) -> TensorDictBase:
        """Return a shallow copy of a batch `[*B, T]` with the options that hold in the next states, `[*B, T]`.

        They are under `("next", "option")`. If an option ends, the option of the next step follows. If the next step is
        not in the batch, the selector's greedy option follows, or one drawn from its policy if that is stochastic.
        """
        option = batch.get(keys.OPTION)
        is_ended = batch.get(("next", keys.OPTION_ENDED)).squeeze(-1)
        is_missing = is_ended & batch.get(("next", keys.DONE)).squeeze(-1)
        is_missing[..., -1] = is_ended[..., -1]
        next_option = torch.where(is_ended, option.roll(-1, -1), option)
        if is_missing.any():
            states = batch.get("next")[is_missing]
            remembered = batch.select(*self.selector.remembered_keys)[is_missing]
            states = states.copy().update(remembered)
            probabilities = self._probabilities(states)
            if probabilities is None:
                next_option[is_missing] = self.greedy(states, option[is_missing])
            else:
                next_option[is_missing] = probabilities.multinomial(1).squeeze(-1)
        return batch.copy().set(keys.NEXT_OPTION, next_option)

    def _without_option(self, observation: Tensor) -> Tensor:
        return observation[..., : -self.num_options] if self.is_shared else observation


class LearnerView(NamedTuple):
    """What a learner sees of a batch.

    Attributes:
        prefix: of its scalars in logs.
        learner: the learner.
        batch: the steps `[*B, T]`, with the next options and, if the learner observes it, the option.
        mask: the steps that are the learner's, bool `[*B, T]`.
    """

    prefix: str
    learner: Learner
    batch: TensorDictBase
    mask: Tensor

    def named(self, scalars: Mapping[str, float]) -> dict[str, float]:
        """Return scalars under their names in logs."""
        return {f"{self.prefix}/{name}": value for name, value in scalars.items()}


class HierarchicalAgent(nn.Module):
    """A selector and its learners: one policy that acts and one call to learn.

    Args:
        selector: the high level; None if the environment leaves no choice.
        learners: one for each option, or a single one.
        specs: of the problem as the environment states it.
        is_shared: whether the single learner observes the option. The learner's specs then count the one-hot option as
            part of the observation.
        is_frozen: whether the learners stay as they are.
        practice: which options practise, whatever the selector would choose. If None, no practice is counted.
        selector_ends_options: whether the selector decides where options end.
        option_lengths: the lengths that the selector chooses from together with an option, in steps. The selector's
            `specs` then list the pairs as options (`PAMDPSpecs.with_option_lengths`). If empty, it chooses options
            alone.
        explorations: the exploration beside each learner; empty if there is none.

    Attributes:
        policy: writes `option`, if there is a selector, and the action leaves.
        router: the low level's part of `policy`.
        pairs: the pairs of options and lengths; None if the selector chooses options alone.
        values_end_with_trips: whether the learners' values end with a trip, if episodes are sessions of trips. The run
            sets this and the next attribute.
        selector_values_end_with_trips: whether the selector's values end with a trip.
        frames: how many steps the agent has learned from; how many decisions, if the learners are frozen.

    Raises:
        ValueError: the selector's `specs` list other options than the pairs.
    """

    values_end_with_trips: bool = False
    selector_values_end_with_trips: bool = False

    def __init__(  # noqa: PLR0913  (the parts of an agent, and what the run says of them)
        self,
        selector: Selector | None,
        learners: Sequence[Learner],
        specs: PAMDPSpecs,
        is_shared: bool = False,
        is_frozen: bool = False,
        practice: Practice | None = None,
        selector_ends_options: bool = False,
        option_lengths: Sequence[int] = (),
        *,
        explorations: Sequence[Exploration] = (),
    ) -> None:
        super().__init__()
        self.selector = selector
        self.learners = cast("Sequence[Learner]", nn.ModuleList(learners))
        self.explorations = cast("Sequence[Exploration]", nn.ModuleList(explorations))
        self.specs = specs
        self.is_shared = is_shared
        self.is_frozen = is_frozen
        self.practice = practice
        self.frames: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))
        self._set_practice()
        self.router = OptionRouter(learners, specs, is_shared, explorations)
        self.option_lengths = tuple(option_lengths)
        self.pairs = OptionLengths(option_lengths) if option_lengths and selector is not None else None
        num_choices = specs.num_options * max(1, len(self.option_lengths))
        if selector is not None and selector.specs.num_options != num_choices:
            raise ValueError(f"the selector has {selector.specs.num_options} options, but must have {num_choices}")
        if selector is None:
            self.policy: TensorDictModuleBase = self.router
        else:
            high = selector if self.pairs is None else PairSelector(selector, self.pairs)
            self.policy = TensorDictSequential(high, self.router)
        self.next_options: AgentNextOptions | None = None
        if selector is not None:
            selector.decides_ends = selector_ends_options
            if selector_ends_options:
                held: list[NestedKey] = [(keys.HELD, key) for key in selector.out_keys]
                self.policy.out_keys = [*self.policy.out_keys, *held]
            if selector.card.asks_learners:
                selector.take_option_values(OptionValues(learners, specs.num_options))
            self.next_options = AgentNextOptions(selector, learners, specs.num_options, is_shared, self.pairs)
            for learner in learners:
                learner.next_options = self.next_options

    def acting_state(self) -> dict[str, Any]:
        """Return the state dict without what explorations keep for training alone, such as a table of counts."""
        return {name: value for name, value in self.state_dict().items() if not name.startswith(FOR_TRAINING)}

    def policy_of(self, option: int) -> TensorDictModuleBase:
        """Return the policy that always holds one option and otherwise acts like this agent."""
        length = None if self.pairs is None else self.pairs.longest
        return TensorDictSequential(HeldOption(option, length), self.router)

    @property
    def choice_keys(self) -> list[NestedKey]:
        """The keys that the high level writes at a decision and holds until the next one; empty without a selector."""
        if self.selector is None:
            return []
        return [*self.selector.out_keys, *([] if self.pairs is None else [keys.OPTION_LENGTH])]

    def learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Let both levels learn from a collected batch `[*B, T]`; return scalars named `high/...` and `low/...`."""
        self.frames += batch.numel()
        scalars: dict[str, float] = {}
        if self.selector is not None and self.next_options is not None:
            batch = self.next_options.with_ends(batch)
            scalars |= self._learn_to_choose(self.selector, self.next_options, batch)
        return scalars if self.is_frozen else scalars | self._learn_to_act(batch)

    def _learn_to_choose(
        self, selector: Selector, options: AgentNextOptions, batch: TensorDictBase
    ) -> dict[str, float]:
        """Let the selector learn from a batch `[*B, T]`, and return scalars to log."""
        seen = steps = self._seen_by_selector(batch)
        self._set_pending(selector, seen)
        if options.decides_ends:
            steps = options.with_steps_before(seen)
            if self.selector_values_end_with_trips:  # the step before the batch may have ended a trip
                steps = ended_with_trips(steps)
        scalars = self._practise(selector, seen, steps)
        learned = {**selector.learn_from_options(steps), **selector.learn_from_steps(seen), **self._mean_length(batch)}
        return scalars | {f"high/{name}": value for name, value in learned.items()}

    def _learn_to_act(self, batch: TensorDictBase) -> dict[str, float]:
        """Let the explorations and the learners learn from a batch `[*B, T]`, and return scalars to log."""
        scalars: dict[str, float] = {}
        views = self._views(ended_with_trips(batch) if self.values_end_with_trips else batch)
        bonuses = []
        for exploration, view in zip(self.explorations, views, strict=False):
            bonus, explored = exploration.learn(view.batch, view.mask)
            bonuses += [] if bonus is None else [bonus]
            scalars |= view.named(explored)
        if bonuses:
            reward = batch.get(("next", keys.REWARD)) + torch.stack(bonuses).sum(0)
            views = [view._replace(batch=view.batch.copy().set(("next", keys.REWARD), reward)) for view in views]
        for view in views:
            scalars |= view.named(view.learner.learn(view.batch, view.mask))
        return scalars

    def add_demonstrations(self, batch: TensorDictBase, decisions: TensorDictBase | None = None) -> None:
        """Let the selector learn from a data set `[*B, T]`, if it can, and the learners keep their own transitions.

        Args:
            batch: the transitions.
            decisions: `[*B, K]` for the selector. If None, the decisions in the batch.
        """
        if self.selector is not None and self.pairs is None and "offline" in self.selector.card.modes:
            self.selector.add_demonstrations(finished_decisions(batch if decisions is None else decisions))
        if self.next_options is not None and self.next_options.decides_ends:
            # A row without its option would be stored with option 0, beside the agent's own rows.
            goes_on = torch.zeros_like(batch.get(("next", keys.DONE)))
            batch = batch.copy().set(("next", keys.OPTION_ENDED), goes_on)
        for view in self._views(batch):
            view.learner.add_demonstrations(view.batch, view.mask)

    def update(self, num_updates: int) -> dict[str, float]:
        """Let both levels make updates from a data set; return scalars named `high/...` and `low/...`."""
        scalars: dict[str, float] = {}
        if self.selector is not None:
            learned = self.selector.update(num_updates)
            scalars.update({f"high/{name}": value for name, value in learned.items()})
        for i, learner in enumerate(self.learners):
            learned = learner.update(num_updates)
            scalars.update({f"{self._prefix_of(i)}/{name}": value for name, value in learned.items()})
        return scalars

    def held_out_losses(self, batch: TensorDictBase) -> dict[str, float]:
        """Return the learners' losses on transitions `[*B, T]` that nothing learns from, by their names in logs."""
        scalars: dict[str, float] = {}
        for view in self._views(batch):
            scalars |= view.named(view.learner.held_out_losses(view.batch, view.mask))
        return scalars

    def without_update(self) -> list[str]:
        """Return the names, as in logs, of the selector and the learners that have made no update yet."""
        levels: list[tuple[str, Level]] = [] if self.selector is None else [("high", self.selector)]
        if not self.is_frozen:
            levels += [(self._prefix_of(i), learner) for i, learner in enumerate(self.learners)]
        return [name for name, level in levels if not level.has_updated()]

    def stateful(self) -> dict[str, Any]:
        """Return what a checkpoint must hold besides parameters and buffers, by level and name."""
        levels: dict[str, Level] = {f"learner{i}": each for i, each in enumerate(self.learners)}
        if self.selector is not None:
            levels["selector"] = self.selector
        owners: dict[str, Level | Exploration] = dict(levels)
        owners |= {f"exploration{i}": exploration for i, exploration in enumerate(self.explorations)}
        return {f"{owner}_{name}": part for owner, module in owners.items() for name, part in module.stateful().items()}

    def exported(self) -> dict[str, Any] | None:
        """Return as JSON values what a program without torch needs to act greedily; None if a part cannot be exported.

        An agent that chooses the lengths of options cannot be exported.

        `selector` is None if there is nothing to choose. `learners` has one entry for each option, or a single one.
        With `is_shared` the single learner observes the one-hot option at the end of the observation.
        """
        learners = [learner.exported() for learner in self.learners]
        selector = None if self.selector is None else self.selector.exported()
        if any(learner is None for learner in learners) or (self.selector is not None and selector is None):
            return None
        if self.pairs is not None:
            return None
        return {"selector": selector, "learners": learners, "is_shared": self.is_shared}

    def _views(self, batch: TensorDictBase) -> list[LearnerView]:
        """Return what each learner sees of a batch `[*B, T]`."""
        if self.next_options is not None and ("next", keys.OPTION_ENDED) in batch.keys(include_nested=True):
            batch = self.next_options.with_next_option(batch)
        if self.is_shared:
            batch = with_option(batch, self.specs.num_options)
        if len(self.learners) == 1:
            masks = [torch.ones(batch.shape, dtype=torch.bool, device=batch.get(keys.OBSERVATION).device)]
        else:
            masks = [batch.get(keys.OPTION) == i for i in range(len(self.learners))]
        return [
            LearnerView(self._prefix_of(i), learner, batch, mask)
            for i, (learner, mask) in enumerate(zip(self.learners, masks, strict=True))
        ]

    def _prefix_of(self, learner: int) -> str:
        return "low" if len(self.learners) == 1 else f"low/{self.specs.option_names[learner]}"

    def _practise(self, selector: Selector, batch: TensorDictBase, steps: TensorDictBase) -> dict[str, float]:
        """Count the practice in a batch `[*B, T]`, and return the next probabilities to log.

        Args:
            selector: the selector.
            batch: its steps.
            steps: those of them whose ends are known, see `Selector.learn_from_options`.
        """
        if self.practice is None:
            return {}
        decisions = finished_decisions(
            steps.select(keys.OPTION, ("next", keys.IS_DECISION), ("next", keys.OPTION_RETURN))
        )
        returns = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1)
        self.practice.add(batch.get(keys.OPTION).flatten(), decisions.get(keys.OPTION), returns)
        self._set_practice()
        if not self.practice.can_overrule:
            return {}
        names = selector.specs.option_names
        return {f"high/practice_{name}": p for name, p in zip(names, selector.practice.tolist(), strict=True)}

    def practised(self) -> dict[str, float]:
        """Return the fraction of the steps that each choice of the selector has practised, by name."""
        if self.selector is None or self.practice is None or not self.practice.own_steps.any():
            return {}
        shares = (self.practice.own_steps / self.practice.own_steps.sum()).tolist()
        return dict(zip(self.selector.specs.option_names, shares, strict=True))

    def _set_practice(self) -> None:
        if self.selector is not None and self.practice is not None:
            self.selector.practice.copy_(self.practice.probabilities(int(self.frames)))

    def _seen_by_selector(self, batch: TensorDictBase) -> TensorDictBase:
        if self.selector_values_end_with_trips:
            batch = ended_with_trips(batch)
        return batch if self.pairs is None else self.pairs.with_pairs(batch)

    def _mean_length(self, batch: TensorDictBase) -> dict[str, float]:
        """Return the mean length chosen in a batch `[*B, T]` as a scalar to log, if any was."""
        if self.pairs is None:
            return {}
        chosen = batch.get(keys.OPTION_LENGTH)[batch.get(keys.IS_DECISION).squeeze(-1)]
        return {"length": chosen.float().mean().item()} if len(chosen) else {}

    def _set_pending(self, selector: Selector, batch: TensorDictBase) -> None:
        last = batch[..., -1]
        is_held = ~last.get(("next", keys.IS_DECISION)).squeeze(-1)
        held = last.get(keys.OPTION)[is_held]
        selector.pending.copy_(torch.bincount(held, minlength=selector.specs.num_options))
