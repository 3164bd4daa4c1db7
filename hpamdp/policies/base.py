"""The two contracts of an agent: `Selector`, the high level, and `Learner`, the low level."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.cards import ActionFeature, LearnerCard, LevelCard, SelectorCard
from hpamdp.messages import as_code
from hpamdp.policies.masks import sample_index
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs


def check_batch(owner: object, step: TensorDictBase) -> None:
    """Refuse a step without a batch dimension.

    Raises:
        ValueError: its batch size is [].
    """
    if not step.batch_dims:
        name = type(owner).__name__
        raise ValueError(f"{name}: the step has batch size [], but must have [N]; for one environment use [1]")


@dataclass(frozen=True)
class Bonus:
    """The reward of an exploration for states that are new; see `LearnerCard.novelty_by`.

    Attributes:
        weight: reward of a bonus of 1.
        of: maps observations `[*B, observation_dim]` to their bonuses `[*B]`, at least 0. If None, the learner measures
            by the disagreement of its own ensemble.
    """

    weight: float
    of: Callable[[Tensor], Tensor] | None

    def scaled(self, factor: float) -> Bonus:
        """Return the same bonus with another weight, for a learner that scales its rewards by this factor."""
        return replace(self, weight=factor * self.weight)


def have_stepped(parts: Mapping[str, Any]) -> bool:
    """Return whether an optimizer among the parts has taken a step; true if no part is an optimizer with a state."""
    # Plain stochastic gradient descent has no state that would show its steps.
    kinds = (part for part in parts.values() if isinstance(part, torch.optim.Optimizer))
    optimizers = [part for part in kinds if not isinstance(part, torch.optim.SGD)]
    return not optimizers or any(optimizer.state for optimizer in optimizers)


def option_ends(batch: TensorDictBase) -> Tensor:
    """Return where an episode or an option ends, bool `[*B, T, 1]`; another option's rows may follow."""
    return known_ends(batch) | batch.get(("next", keys.OPTION_ENDED), False)


def known_ends(batch: TensorDictBase) -> Tensor:
    """Return where an episode or an option is known to end, bool `[*B, T, 1]`.

    If the selector decides where options end, only the next batch shows whether one ends with the last step, by
    `is_decision` of its first root. `option_ends` counts the last step, this function does not.
    """
    return batch.get(("next", keys.DONE)) | batch.get(("next", keys.IS_DECISION), False)


def added_later(module: nn.Module) -> set[str]:
    """Return the names of the entries of a state dict that checkpoints of earlier versions lack.

    Modules list theirs in `added_later`. An entry that a checkpoint lacks keeps its initial value.
    """
    parts = module.named_modules(remove_duplicate=False)
    return {f"{prefix}.{name}".lstrip(".") for prefix, part in parts for name in getattr(part, "added_later", ())}


def step_discounts(batch: TensorDictBase, gamma: float) -> float | Tensor:
    """Return `gamma`; if the environment writes durations, `gamma ** duration` of each step, `[*B, T, 1]`.

    With one discount per step, an agent could put off costs by taking many short steps, which discount the future more.
    H-PPO and the learners with a replay buffer count durations. Q-PAMDP, learners that plan and selectors do not.
    """
    duration = batch.get(("next", keys.DURATION), None)
    return gamma if duration is None else gamma**duration


def finished_decisions(steps: TensorDictBase) -> TensorDictBase:
    """Return the last step of every option that ended in steps `[*B, T]`, `[N]`, oldest first."""
    is_end = steps.get(("next", keys.IS_DECISION)).squeeze(-1)
    return steps.transpose(0, -1)[is_end.transpose(0, -1)]


class States(NamedTuple):
    """States `[N]` whose values are asked for.

    Attributes:
        observation: of the states, `[N, observation_dim]`, in the form that the asked learner sees.
        action_mask: the allowed discrete actions, bool `[N, num_discrete]`. If None, all are.
        memory: what a learner's policy remembers there, `[N, size]`; zeros where an option begins. If None, nothing.
        memory_key: the `memory_key` of that learner.
        has_seen: whether the memory has seen the observations already, as that of a stored step has.
    """

    observation: Tensor
    action_mask: Tensor | None = None
    memory: Tensor | None = None
    memory_key: str | None = None
    has_seen: bool = False

    def at(self, rows: Tensor) -> States:
        """Return the states in some rows, bool `[N]`."""
        mask, memory = (None if each is None else each[rows] for each in (self.action_mask, self.memory))
        return self._replace(observation=self.observation[rows], action_mask=mask, memory=memory)

    def for_memory(self, memory_key: str | None) -> States:
        """Return the states for a learner whose memory has this key, which cannot read another memory."""
        return self if memory_key == self.memory_key else self._replace(memory=None, memory_key=None, has_seen=False)


class NextOptions(Protocol):
    """Which options follow the one that ended, and their values; the agent gives it to its learners.

    If an option has ended in a state, the value of that state is its value under the next option, by that option's
    own learner. Learners reach one another in this way only. Observations are in the form that the asking learner sees.
    """

    def value(self, states: States, option: Tensor) -> Tensor:
        """Return the values `[N]` of states under the options chosen there, int64 `[N]`."""
        ...

    @property
    def decides_ends(self) -> bool:
        """Whether the selector decides where options end. If not, stored ends stay valid."""
        ...

    def choose(self, observation: Tensor, option: Tensor, held: Tensor) -> Tensor:
        """Return the options `[N]` that the selector would choose greedily now.

        If the selector decides that the held option goes on, the held option is returned. If the selector needs more
        than the observation, the options chosen at the time are returned.

        Args:
            observation: of the states in which an option has ended or may end, `[N, observation_dim]`.
            option: the options chosen at the time, `[N]`.
            held: the options before, `[N]`.
        """
        ...

    def probabilities(self, observation: Tensor) -> Tensor | None:
        """Return with which probability the selector would choose each option now, `[N, num_options]`.

        None if its choice is certain, if it decides where options end, or if it needs more than the observation. Then
        see `choose`.

        Args:
            observation: of the states in which an option has ended, `[N, observation_dim]`.
        """
        ...


class Level:
    """What a checkpoint and an export need from a selector or a learner; a base of both.

    Attributes:
        specs: sizes and bounds of the problem.
        card: what the class declares.
        export_refusal: why its greedy policy cannot be exported to ONNX. If None, it can.
    """

    card: ClassVar[LevelCard]
    export_refusal: str | None = None
    specs: PAMDPSpecs

    def __new__(cls, *given: Any, **settings: Any) -> Any:
        """Refuse the first argument of other libraries, such as `MlpPolicy`, whatever follows it."""
        first = given[0] if given else settings.get("policy")
        if isinstance(first, str):
            cure = "must be PAMDPSpecs.from_env(env); hpamdp.train(env, low=...) trains an agent"
            raise SettingError(f"{cls.__name__}: specs={as_code(first)}: {cure}")
        return super().__new__(cls)

    def check_specs(self, specs: PAMDPSpecs) -> None:
        """Refuse anything but specs, and pictures unless the card says `takes_pictures`.

        Raises:
            SettingError: they are no specs, or an entry of the observation is a picture.
        """
        if not isinstance(specs, PAMDPSpecs):
            raise SettingError(f"{type(self).__name__}: specs={as_code(specs)}: must be PAMDPSpecs.from_env(env)")
        if specs.has_pictures and not self.card.takes_pictures:
            raise SettingError(f"{type(self).__name__}: has no encoder for pictures; encoder=mlp flattens them")

    def stateful(self) -> dict[str, Any]:
        """Return what a checkpoint must hold besides parameters and buffers, by name.

        Each value is an optimizer, a TorchRL `ReplayBuffer`, or has a `state_dict` of tensors, numbers and text, with
        constant names and shapes.
        """
        return {}

    def has_updated(self) -> bool:
        """Return whether an update was made, or there is nothing to learn. The run reports levels without an update.

        By default the optimizers in `stateful` decide. Override it for learning without an optimizer.
        """
        return have_stepped(self.stateful())

    def exported(self) -> dict[str, Any] | None:
        """Return as JSON values what a program without torch needs to act greedily; None if it cannot be exported.

        `kind` names the form, which `hpamdp.policies.shared.exported_policy` explains.
        """
        return None


_CERTAIN = 0.999  # probabilities that sum to 1 may sum to slightly less in float32


class Selector(Level, TensorDictModuleBase):
    """The high level: chooses an option at every decision and holds it until the next one.

    A decision is due if an episode begins or the previous option has ended. `forward` holds the options between
    decisions. A subclass writes `select` and, if it learns, `learn`::

        class GreedyMean(Selector):  # epsilon-greedy by the options' mean rewards; no option may be forbidden
            def __init__(self, specs: PAMDPSpecs, *, epsilon: Fraction) -> None:
                super().__init__(specs)
                self.epsilon = epsilon
                self.sums = nn.Buffer(torch.zeros(specs.num_options))
                self.counts = nn.Buffer(torch.zeros(specs.num_options))

            def select(self, td: TensorDictBase) -> Tensor:
                best = (self.sums / self.counts.clamp(min=1.0)).argmax().expand(td.batch_size)
                if is_greedy():
                    return best
                is_random = torch.rand_like(best, dtype=torch.float32) < self.epsilon
                return torch.where(is_random, torch.randint_like(best, self.specs.num_options), best)

            def learn(self, decisions: TensorDictBase) -> dict[str, float]:
                option = decisions.get(keys.OPTION)
                reward = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1)
                self.sums.index_add_(0, option, reward)
                self.counts.index_add_(0, option, torch.ones_like(reward))
                return {"reward": reward.mean().item()}

    Constructor: `specs` holds the sizes of the problem. The argument `device`, if it exists, says where tensors live.
    Settings are fields of a model `Options`, see `hpamdp.settings`, or keyword-only arguments as above. Their names and
    types are the schema of the selector's yaml in `conf/high`. A selector never sees the environment, the config or the
    agent.

    Tensordict: `forward` gets the current step of `[*B]` environments. It reads `in_keys`: `observation`
    `[*B, observation_dim]`, `is_decision` bool `[*B, 1]` and, if the problem forbids options, `option_mask` bool
    `[*B, num_options]`. Forbidden options must neither be chosen nor count in a target. `forward` writes `out_keys`:
    `option` int64 `[*B]`. If `learn` needs to know more about a choice, such as its log-probability, append a key to
    `out_keys`, and return it from `held_with`, with first dimensions `[*B]`. The key is held with the option and is in
    the batch that `learn` gets.

    State: the same module acts in training and evaluation, with different numbers of environments. So the state of an
    episode belongs in the tensordict. What the selector has learned belongs in parameters and buffers, which are saved
    in checkpoints and sent to collector processes. `stateful` returns everything else that training needs, such as
    optimizers and replay buffers.

    Attributes:
        card: what the class declares.
        option_values: the learners' values of each option, `[N, num_options]`, as a function of `States`. The agent
            gives it if the card says `asks_learners`.
        gamma: discount of an environment step, whatever the length of the options. It discounts `option_return` and
            the value of the next decision, see `next_discount`.
        decides_ends: whether the selector decides where options end, by `ends`, in this run
            (`agent.termination=learned`). The agent sets it.
        memory_key: key of the selector's memory of earlier decisions in a step; None if it has no memory.
        practice: probability that an exploring decision is overruled in favour of each option, `[num_options]`, a
            buffer that the agent sets. With the remaining probability the selector chooses.
        pending: how many decisions for each option have not yet reached `learn`, int64 `[num_options]`. The agent sets
            this buffer after every batch. A selector that needs the number within a batch adds its own choices.
    """

    card: ClassVar[SelectorCard] = SelectorCard()
    added_later: ClassVar[tuple[str, ...]] = ("practice",)  # checkpoints of 0.3 have `is_uniform` in its place
    decides_ends: bool = False
    gamma: float = 1.0
    memory_key: str | None = None
    option_values: nn.Module

    in_keys: list[NestedKey]
    out_keys: list[NestedKey]

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.check_specs(specs)
        self.in_keys = [keys.OBSERVATION, keys.IS_DECISION]
        if specs.has_option_mask:
            self.in_keys.append(keys.OPTION_MASK)
        self.out_keys = [keys.OPTION]
        self.specs = specs
        self.practice = nn.Buffer(torch.zeros(specs.num_options, dtype=torch.float32))
        self.pending: Tensor = nn.Buffer(torch.zeros(specs.num_options, dtype=torch.long))

    def select(self, td: TensorDictBase) -> Tensor:
        """Return an option for every environment, int64 `[*B]`.

        Choose greedily if `is_greedy()`, else explore. If no decision is due, the choice is ignored.
        """
        raise NotImplementedError

    def held_with(self, td: TensorDictBase, option: Tensor) -> dict[str, Tensor]:
        """Return what is held with the options that were chosen or practise in a step: a tensor `[*B, ...]` a key.

        Override it if `out_keys` has more than the option.

        Args:
            td: the step `[*B]`.
            option: the options, int64 `[*B]`. Where no decision is due, they are ignored.
        """
        return {}

    @property
    def remembered_keys(self) -> list[str]:
        """The keys that the step before has written and that a decision depends on."""
        return [] if self.memory_key is None else [self.memory_key]

    def take_option_values(self, option_values: nn.Module) -> None:
        """Compare the learners' values of the options from now on, if the card says `asks_learners`."""
        self.option_values = option_values

    def option_probabilities(self, td: TensorDictBase) -> Tensor | None:
        """Return the probabilities of the options at a decision, `[*B, num_options]`; None if one is certain.

        They are those of the policy that the selector follows or learns, without exploration. Off-policy learners
        bootstrap from the mean of the options' values with these weights. Override it if that policy is stochastic.
        """
        return None

    def greedy_choice(self) -> Callable[[TensorDictBase], Tensor]:
        """Return the function from a step `[*B]` to the greedy option of each environment, int64 `[*B]`, for an export.

        Called while `is_greedy()`. The function is traced, so its control flow must not depend on numbers in tensors.
        What depends on buffers alone is better computed before it is returned. Override it if `select` does not fit.
        """
        return self.select

    def practice_in(self, td: TensorDictBase) -> Tensor:
        """Return with which probability each option practises in a step, `[*B, num_options]`, 0 where forbidden."""
        practice = self.practice.expand(*td.batch_size, -1)
        mask = td.get(keys.OPTION_MASK, None)
        if mask is None:
            return practice
        if self.practice.sum() < _CERTAIN:  # the selector chooses where an option that should practise is forbidden
            return practice * mask
        allowed = practice.clamp(min=1e-9) * mask  # if no allowed option has practice, sample one uniformly
        return allowed / allowed.sum(-1, keepdim=True).clamp(min=1e-9)

    def exploring_probabilities(self, td: TensorDictBase, own: Tensor) -> Tensor:
        """Return with which probability exploring decisions fall on each option, by practice or by choice.

        Args:
            td: the step `[*B]`.
            own: the selector's own probabilities, `[*B, num_options]`, 0 where forbidden.
        """
        practice = self.practice_in(td)
        return (1.0 - practice.sum(-1, keepdim=True)) * own + practice

    def ends(self, td: TensorDictBase) -> Tensor:
        """Return whether the held `option` of `td` ends in each environment, bool `[*B]`.

        Called at every step but the first of an episode, if `decides_ends`. Override it if the card says
        `ends_options`.
        """
        raise NotImplementedError(f"{type(self).__name__} does not decide where options end")

    def learn_from_steps(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from every step of a collected batch `[*B, T]`, in the form of `Learner.learn`; return scalars to log.

        Called after `learn_from_options`. Override it if the selector learns within options.
        """
        return {}

    def learn_from_options(self, steps: TensorDictBase) -> dict[str, float]:
        """Learn from the options that ended in steps `[*B, T]`, and return scalars to log as `high/<name>`.

        The default passes them to `learn`. Override it if decisions must be told apart by environment.

        Args:
            steps: the last step of an option is marked by `("next", "is_decision")`, bool `[*B, T, 1]`. For the entries
                of such a step see `learn`.
        """
        decisions = finished_decisions(steps)
        return self.learn(decisions) if len(decisions) else {}

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Learn from finished decisions `[N]`, oldest first, and return scalars to log as `high/<name>`.

        Called after each collected batch in which an option ended, before the learners learn from the batch. If the
        selector decides where options end, an option that ended with a batch is reported with the next batch.

        A decision is represented by the last step of its option:

        - `option` int64 `[N]` and the other `out_keys`, as chosen (a data set holds `option` alone);
        - `("next", "decision_observation")` `[N, observation_dim]`: the observation at the decision;
        - `("next", "option_return")` `[N, 1]`: the sum of the option's rewards, discounted by `gamma`;
        - `("next", "option_steps")` int64 `[N, 1]`: how many steps the option took;
        - `("next", "observation")` `[N, observation_dim]`: the state in which it ended;
        - `("next", "done")` bool `[N, 1]`: whether its episode ended there, too.

        `observation`, without `next`, belongs to the option's last step. The choice was not based on it. It is missing
        if the selector decides where options end.
        """
        return {}

    def add_demonstrations(self, decisions: TensorDictBase) -> None:
        """Learn from the decisions `[N]` of a data set, as in `learn`, or keep them for `update`.

        Called once, before training, on selectors with the mode `offline`. Exploration does not decay with these
        decisions, since the selector has not made them. Override it if `learn` counts decisions or makes updates.
        """
        self.learn(decisions)

    def update(self, num_updates: int) -> dict[str, float]:
        """Make updates from the decisions of a data set and return scalars to log, averaged over them.

        Called repeatedly with `mode=offline`, in which `learn` is not called, on selectors with the mode `offline`.
        Selectors that learn in closed form need not override it.
        """
        return {}

    def next_discount(self, decisions: TensorDictBase) -> Tensor:
        """Return the factor `[N]` of the next decision's value in the target of each of the decisions `[N]`.

        It is `gamma ** option_steps` if the option ended inside its episode. It is 0 if the episode ended, also by its
        time limit. Otherwise an option that idles until the limit would look as valuable as the best one.
        """
        after = decisions.get("next")
        goes_on = ~after.get(keys.DONE).squeeze(-1)
        return self.gamma ** after.get(keys.OPTION_STEPS).squeeze(-1).float() * goes_on

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write `out_keys`: a fresh choice if `is_decision` is true, else what `td` already holds.

        If the selector decides where options end, what `td` held before is kept under `held`: the choice whose option
        has ended here. Where an episode begins, nothing was held, and the entries mean nothing.

        Raises:
            ValueError: the step has no batch dimension, or no `is_decision`.
        """
        check_batch(self, td)
        is_decision = td.get(keys.IS_DECISION, None)
        if is_decision is None:
            raise ValueError(f"{type(self).__name__}: the step has no {keys.IS_DECISION}, bool [N, 1]")
        is_decision = is_decision.squeeze(-1)
        held = {key: td.get(key, None) for key in self.out_keys}
        nothing_held = any(value is None for value in held.values())
        if self.decides_ends and not nothing_held:
            is_decision = is_decision | self.ends(td)
            td.set(keys.IS_DECISION, is_decision.unsqueeze(-1))
            for key, value in held.items():
                td.set((keys.HELD, key), value)
        if not nothing_held and not is_decision.any():
            return td
        option = self._choose_or_practise(td)
        for key, value in {keys.OPTION: option, **self.held_with(td, option)}.items():
            if self.decides_ends and nothing_held:
                td.set((keys.HELD, key), value)
            td.set(key, value if nothing_held else _where(is_decision, value, held[key]))
        return td

    def _choose_or_practise(self, td: TensorDictBase) -> Tensor:
        """Return the options of `select`; if exploring, options practise in their place with their probabilities."""
        if is_greedy() or not self.practice.any():
            return self.select(td)
        practising = sample_index(self.practice_in(td).log())
        if self.practice.sum() > _CERTAIN:
            return practising
        draw = torch.rand(td.batch_size, device=self.practice.device, dtype=torch.float32)
        practises = draw < self.practice_in(td).sum(-1)
        is_decision = td.get(keys.IS_DECISION) & ~practises.unsqueeze(-1)
        return torch.where(practises, practising, self.select(td.copy().set(keys.IS_DECISION, is_decision)))


def _where(rows: Tensor, value: Tensor, other: Tensor) -> Tensor:
    """Return `value` `[*B, ...]` in the rows that are true, bool `[*B]`, and `other` elsewhere."""
    return torch.where(rows.reshape(*rows.shape, *[1] * (value.ndim - rows.ndim)), value, other)


class Learner(Level, nn.Module):
    """The low level: learns which discrete action to take, and with which parameters.

    By default each option has its own learner. With `agent.sharing=shared` a single learner serves all options, and the
    one-hot option is the end of its observation. A subclass provides:

    - `policy`, which acts;
    - `card`, what it takes, needs and gives (`LearnerCard`);
    - `learn`, to learn from the agent's own transitions;
    - `add_demonstrations` and `update`, to learn from a data set, and `"offline"` in the `modes` of its card;
    - `value`, and `has_value` in its card, if it bootstraps, so that other options' learners can bootstrap from it;
    - `stateful`, if it has optimizers or a replay buffer.

    If an option ends inside its episode, the value of the next state is its value under the next option. The batch then
    has `("next", "option_ended")`, and `("next", "option")` is the option that holds in the next state. `next_options`
    has the values. If options last as long as their episodes, these keys do not exist.

    `policies.shared.replay.ReplayLearner` implements `learn`, `add_demonstrations`, `update` and `stateful` for
    off-policy learners. The smallest complete learner is `policies.low_level.random.Random`.

    Constructor: `specs` holds the sizes and bounds of the problem, and the symmetries and geometry that it declares.
    The argument `device`, if it exists, says where tensors live. Settings are fields of a model `Options`, see
    `hpamdp.settings`, or keyword-only arguments. Their names and types are the schema of the learner's yaml in
    `conf/low`. A learner never sees the environment, the config, the agent or another learner.

    Policy: `policy` reads its `in_keys`, usually `observation` `[*B, observation_dim]`. It writes its `out_keys`:
    `("action", "discrete")` int64 `[*B]` and `("action", "parameters")` `[*B, num_parameters]`, within their bounds.
    With several components, see `hpamdp.components`, the discrete actions are `[*B, num_components]`.
    The parameters of all discrete actions lie side by side. Only the parameters of the chosen action have an effect.
    `specs.parameter_mask` says which action owns which parameter, and `specs.from_unit` maps [-1, 1] to the bounds.
    `is_greedy()` says whether to act greedily or to explore.

    - `specs.allowed(observation, td.get("action_mask", None))` says which discrete actions are allowed, in the policy
      as in `learn`. It is None if nothing is forbidden. Forbidden actions must neither be taken nor count in a target.
    - If `learn` needs to know more about an action, such as its log-probability, append a key to the policy's
      `out_keys`. The key is in the batch that `learn` gets.
    - The policy gets only the environments whose option is its learner's, so their number changes from step to step. It
      also acts in evaluation. So the module must not remember anything about an episode. State that the policy needs
      from step to step travels in the tensordict: its key `[*B, ...]` is among both `in_keys` and `out_keys`. The key
      is missing before the first step. If `is_decision` is true, its value is left over from an earlier option.
    - The policy may run as a copy in another process, which receives its parameters and buffers only. So whatever
      changes during training, such as an exploration rate, must be one of them.

    Attributes:
        policy: the module that acts.
        card: what the class declares.
        memory_key: key of the memory's state in a step, if the policy and `value` have a memory; else None.
        memory_lasts_an_episode: whether that memory remembers the whole episode, and not the option alone.
        exploring_keys: those of the policy's states that only exploration reads. They do not keep it from an export.
        is_overruled: whether an exploration sometimes takes another action than the policy's. Then `is_held` marks the
            steps in the batch, bool `[*B, T]`, and what the policy writes beside the action is not of that action. An
            exploration sets it.
        bonus: the reward for new states; None if there is none.
        progress: the buffers, by the last part of their names, that count the steps of a run, or follow from such
            counters. They are reset if a new run takes over the learner.
        next_options: which options follow one that ended, and their values. The agent sets it.
        while_compiling: makes a context for updates that are compiled first, which takes seconds. The run sets it.
    """

    card: ClassVar[LearnerCard] = LearnerCard()
    memory_key: str | None = None
    memory_lasts_an_episode: bool = False
    exploring_keys: ClassVar[frozenset[str]] = frozenset()
    progress: ClassVar[frozenset[str]] = frozenset({"frames", "epsilon", "is_random"})
    is_overruled: bool = False
    bonus: Bonus | None = None

    policy: TensorDictModuleBase
    next_options: NextOptions
    while_compiling: Callable[[], AbstractContextManager] = nullcontext

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.check_specs(specs)
        self.specs = specs
        present = {
            ActionFeature.COMPONENTS: not specs.components.is_single,
            ActionFeature.PAIR_MASK: specs.has_pair_mask,
            ActionFeature.PARAMETER_BOUNDS: specs.has_parameter_bounds,
        }
        for feature, is_present in present.items():
            if is_present and feature not in self.card.takes:
                raise SettingError(
                    f"{type(self).__name__} cannot learn {feature.value}; hppo, for example, can (docs/spaces.md)"
                )

    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return the values `[N]` of states `[N]` from which this learner would bootstrap.

        Target networks give the value, if the learner has any.

        Args:
            states: the states.
            is_target: whether a target is made of the values, as with the target smoothing of TD3.
        """
        raise NotImplementedError(f"{type(self).__name__} has no value to bootstrap from")

    def is_untrained(self) -> bool:
        """Return whether parameters and buffers show that `value` still comes from untrained networks.

        While exploring, `high=value` chooses the options of such learners first, so that all of them get data.
        """
        return False

    def take_bonus(self, bonus: Bonus) -> None:
        """Learn with a reward for new states from now on; an exploration calls it. Override it if plans need it.

        Raises:
            SettingError: the learner cannot use this bonus.
        """
        self.bonus = bonus

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Learn from a collected batch `[*B, T]` and return scalars to log, averaged over the updates made.

        Called after every batch, even if none of its transitions is this learner's. The learner decides when and how
        often it updates. The scalars are logged as `low/<name>`, or `low/<option>/<name>` with several learners.

        Args:
            batch: consecutive steps along `T`. At the root: `observation`, `option` (if the problem has options) and
                the policy's `out_keys`. Under `next`: `observation`, `reward` `[*B, T, 1]` and bool `[*B, T, 1]`
                `terminated`, `truncated`, `done` and `is_decision`. A time limit is `truncated`, not `terminated`, so
                values may bootstrap there. If options may end inside their episodes, `next` also holds `option_ended`
                bool `[*B, T, 1]` and `option` int64 `[*B, T]`. After `option_ends`, the next step may belong to another
                learner. All learners get the same batch, and the collector may reuse its memory. So do not modify it,
                and copy what must last.
            mask: bool `[*B, T]`, the transitions that are this learner's.
        """
        return {}

    def add_demonstrations(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Keep the transitions of a data set `[*B, T]` that are in `mask`, bool `[*B, T]`, to learn from them later.

        Called once, before training, on learners with the mode `offline`. The batch has the keys of a collected one
        except for what the policy writes besides the action.
        """
        raise NotImplementedError

    def update(self, num_updates: int) -> dict[str, float]:
        """Make updates from the stored transitions and return scalars to log, averaged over them.

        Called repeatedly with `mode=offline`, in which `learn` is not called, on learners with the mode `offline`.
        """
        raise NotImplementedError

    def held_out_losses(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Return losses on transitions in `mask` that the learner has not learned from, without learning from them.

        Called before a row of metrics with `mode=offline`, if the data set holds people out. Override it if a held-out
        loss tells how good the learner is.
        """
        return {}

    def compile_updates(self) -> None:
        """Make updates by code that `torch.compile` compiles. Override it if the learner can.

        Raises:
            ValueError: it cannot, or this machine cannot.
        """
        raise ValueError("its updates cannot be compiled")

    def lower_precision(self) -> None:
        """Make the matrix products of updates in bfloat16, all else in float32. Override it if the learner can.

        Raises:
            ValueError: it cannot.
        """
        raise ValueError("its updates are made in float32 alone")

    def load_networks(self, state: Mapping[str, Tensor]) -> None:
        """Take over what an earlier run's learner has learned, but not how far its run had come (`progress`).

        Args:
            state: the `state_dict` of that learner.

        Raises:
            RuntimeError: the state is of a learner of another class or size.
        """
        own = self.state_dict()
        fresh = {name: value for name, value in own.items() if name.rpartition(".")[2] in self.progress}
        later = {name: own[name] for name in added_later(self) - state.keys()}
        self.load_state_dict({**state, **later, **fresh})

    def num_updates(self, steps: int) -> int:
        """Return about how many gradient steps the learner takes in this many steps of its own.

        `compile_updates=auto` compiles the updates of learners that take many. Override it if they can be compiled.
        """
        return 0
