"""What classes declare of themselves, one frozen card for each class.

A run compares the cards of its parts before it builds any of them (`hpamdp.run.compatibility`). The cards of this
package's classes stand beside their settings, in modules that import no torch: the card of `package.module.Class` is
`CARDS["Class"]` of `package.module_options` or, if there is no such module, of `package.options`. A class of your own
has its card as an attribute::

    class Mine(Learner):
        card = LearnerCard(takes_pictures=True)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import Enum
from typing import Literal

from hpamdp.settings import Settings


class ActionFeature(Enum):
    """What an action may have beyond one choice with bounded parameters, and its name in refusals."""

    COMPONENTS = "an action of several components"
    PAIR_MASK = "a pair_mask, which forbids pairs of discrete actions"
    PARAMETER_BOUNDS = "bounds of the parameters that depend on the state"


@dataclass(frozen=True, kw_only=True)
class Card:
    """What every class declares.

    Attributes:
        options: the model of the class's settings, its `Options`. If None, the class has no settings. It is read for
            the classes of this package alone.
        guarded_settings: settings that can run code, read files or reach servers: `name`, or `name=value` if only that
            value can. A saved config needs the user's permission to set them.
        unguarded_values: values of these settings that need no permission.
    """

    options: type[Settings] | None = None
    guarded_settings: tuple[str, ...] = ()
    unguarded_values: Mapping[str, tuple[object, ...]] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class ProblemCard(Card):
    """What an environment declares.

    Attributes:
        has_trips: whether an episode is a session: several trips, one after another, through which something unseen
            stays the same. An agent can learn what that is in one trip and use it in the next ones (Duan et al. 2016,
            *RL^2*). The environment reports the ends of trips as `trip_ended`.
        choice_setting: a setting with which the agent chooses an option, for errors.
        no_choice_setting: a setting with which there is nothing to choose, for errors.
        change_setting: a setting with which an option may end before its episode, if others forbid it, for errors.
    """

    has_trips: bool = False
    choice_setting: str = ""
    no_choice_setting: str = ""
    change_setting: str = ""


@dataclass(frozen=True, kw_only=True)
class LevelCard(Card):
    """What selectors and learners declare.

    Attributes:
        modes: what the level can learn from: the agent's own steps (`train`), or a data set (`offline`, for
            `mode=offline` and for `data=...` with `mode=train`). A data set lacks the keys that a selector or a policy
            writes beside its choice.
        needs: names of constructor arguments of the environment which the run sets to true. With `oracle`, the
            environment also writes its planner's best action for each option (the `ORACLE_` keys of `hpamdp.keys`).
            With `human`, it writes the probabilities of human choices (`HUMAN_OPTION`). Environments without such an
            argument are refused. Append the keys to `in_keys`.
        takes_pictures: whether observations may have pictures, because they go through `policies.shared.perception` or
            nothing reads them. If not, pictures are refused: they are flattened only if the user asks for it.
        counts_durations: whether discounts are those of `policies.base.step_discounts`. A run warns if the environment
            writes durations and the level does not count them.
    """

    modes: tuple[str, ...] = ("train", "offline")
    needs: tuple[str, ...] = ()
    takes_pictures: bool = False
    counts_durations: bool = False


@dataclass(frozen=True, kw_only=True)
class SelectorCard(LevelCard):
    """What a selector declares.

    Attributes:
        asks_learners: whether the selector needs `option_values`.
        sees_state: whether the selector tells by the state which option is best. If true, `agent.practice=auto` can
            mean `curves`.
        is_bandit: true if the selector uses an option's return as its full value, that is, does not bootstrap. Its
            options must last as long as their episodes or trips; others are refused.
        ends_options: whether the selector can decide where options end, by `ends`.
        lengths_refusal: why the selector cannot choose pairs of an option and its length (`agent.termination=chosen`).
            If None, it can: its `specs` then list the pairs as options. A selector with `needs`, or that
            `asks_learners`, is refused in any case.
    """

    asks_learners: bool = False
    sees_state: bool = False
    is_bandit: bool = False
    ends_options: bool = False
    lengths_refusal: str | None = None


@dataclass(frozen=True, kw_only=True)
class LearnerCard(LevelCard):
    """What a learner declares.

    Attributes:
        takes: the features of actions that the learner can handle. Problems with other features are refused. With
            `COMPONENTS`, see `hpamdp.components`. With `PARAMETER_BOUNDS`, pass the step to `specs.from_unit` and
            `specs.to_unit`.
        has_value: whether the learner has a `value`, from which the learners of other options can bootstrap.
        value_setting: setting that must be true for `value` to work. If None, `value` always works.
        remembers_directions: whether the learner remembers the directions of actions that a problem reveals, unless it
            has another memory or `augment=false`.
        step_sizes: settings that give the sizes of what the policy writes into steps, beside the action.
        needs_current_policy: whether each batch must be of the policy after the last update. A collector that collects
            ahead is refused.
        explores_with: what an exploration beside the learner may change (`ExplorationCard.changes`). With `actions`,
            the learner may be `is_overruled`; with `rewards`, it may have a `bonus`. Other explorations are refused.
        novelty_by: where a bonus for new states counts. `reward`: the agent adds it to the rewards of the batch.
            `sample`: the learner adds it to the rewards that it samples. `plan`: the learner adds it to the rewards of
            the states in its exploring plans.
        knows_disagreement: whether the learner has an ensemble that predicts states, whose disagreement can be the
            bonus of plans.
    """

    modes: tuple[str, ...] = ("train",)
    takes: frozenset[ActionFeature] = frozenset()
    has_value: bool = False
    value_setting: str | None = None
    remembers_directions: bool = False
    step_sizes: tuple[str, ...] = ()
    needs_current_policy: bool = False
    explores_with: frozenset[str] = frozenset()
    novelty_by: Literal["reward", "sample", "plan"] = "reward"
    knows_disagreement: bool = False


@dataclass(frozen=True, kw_only=True)
class EncoderCard(Card):
    """What an encoder declares.

    Attributes:
        flattens: if true, the environment makes pictures part of the vector, and no encoder is made.
    """

    flattens: bool = False


@dataclass(frozen=True, kw_only=True)
class ExplorationCard(Card):
    """What an exploration declares.

    Attributes:
        changes: what it changes: the `actions` that are taken, or the `rewards` that are learned from. Learners say
            which they take (`LearnerCard.explores_with`).
    """

    changes: Literal["actions", "rewards", "nothing"] = "nothing"


@dataclass(frozen=True, kw_only=True)
class DataCard(Card):
    """What a data set declares."""


@dataclass(frozen=True, kw_only=True)
class LoggerCard(Card):
    """What a logger declares."""


@dataclass(frozen=True, kw_only=True)
class CollectorCard(Card):
    """What a collector declares.

    Attributes:
        package: a package that must be installed; None if there is none.
        has_workers: whether other processes step the environments.
    """

    package: str | None = None
    has_workers: bool = False


@dataclass(frozen=True, kw_only=True)
class CallbackCard(Card):
    """What a callback declares.

    Attributes:
        needs_evaluations: whether the callback counts evaluations during training. Runs without them are refused.
    """

    needs_evaluations: bool = False


def outside_card(cls: type, card: type[Card]) -> str | None:
    """Return what to do about a class that has a field of its card as an attribute of its own; None if it has none."""
    names = [each.name for each in fields(card) if each.name != "options" and hasattr(cls, each.name)]
    return f"{names[0]} belongs to its card; write card = {card.__name__}({names[0]}=...)" if names else None
