"""The settings and the cards of the selectors."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from hpamdp.cards import SelectorCard
from hpamdp.policies.shared.bandit_options import (
    BANDIT_CARD,
    LINEAR_BANDIT_CARD,
    BanditOptions,
    LinearBanditOptions,
    SessionBanditOptions,
)
from hpamdp.policies.shared.options import (
    MemoryOptions,
    OnPolicyOptions,
    OptionValueOptions,
    ReplayMemoryOptions,
    StackOptions,
)
from hpamdp.settings import Fraction, LearningRate, OnlyWith, OwnSteps, PositiveFraction, Schedule, Settings, Widths


class EpsilonGreedyOptions(BanditOptions):
    """Settings of `EpsilonGreedy`."""

    epsilon_scale: Annotated[PositiveFloat, OwnSteps()] = 100.0
    """The probability of a random option is `epsilon_scale` / t, at most 1.

    t counts the decisions of all environments, uniform ones included, but not those of a data set.
    """
    epsilon_final: Annotated[Fraction, OwnSteps()] = 0.1
    """Lower bound of that probability; 0 suits stationary rewards."""


class Exp3Options(BanditOptions):
    """Settings of `Exp3`."""

    exploration: PositiveFraction = 0.1
    """Gamma of the source: the probability of a uniform choice, and the scale of the gains."""


class ThompsonOptions(SessionBanditOptions):
    """Settings of `Thompson`."""

    exploration: PositiveFloat = 1.0
    """Factor of the posteriors' standard deviation; 1 is Bayesian."""


class UCBOptions(SessionBanditOptions):
    """Settings of `UCB`; with `memory=all` it is UCB1."""

    exploration: PositiveFloat = 2.0
    """Width of the bounds, in standard deviations of the rewards. It falls with every choice of an option."""


class LinUCBOptions(LinearBanditOptions):
    """Settings of `LinUCB`."""

    exploration: PositiveFloat = 2.0
    """Width of the bounds, in standard deviations of the prediction; alpha in the source."""


class ActorOptions(MemoryOptions, OnPolicyOptions):
    """Settings of `Actor`; the rows of an update are decisions."""

    hidden_dims: Widths = (128, 128)
    """Hidden layers of the policy and of the value network."""
    gamma: PositiveFraction = 0.99
    """Discount of an environment step, both within an option's return and for the value of the next decision."""
    epochs: Annotated[int, Field(ge=1, le=1000)] = 4
    """Passes over the collected decisions in an update."""
    minibatch_size: PositiveInt = 64
    """Decisions in a gradient step, and the least number of decisions that an update waits for."""
    entropy: NonNegativeFloat = 0.1
    """Weight of the entropy bonus. With 0.02 the policy settles on the option whose learner improves first."""


class MetaCriticOptions(ReplayMemoryOptions, OptionValueOptions):
    """Settings of `MetaCritic`; an update learns from stored decisions."""

    num_members: PositiveInt = 3
    """Number of critics in the ensemble."""
    exploration: Literal["epsilon", "ucb"] = "epsilon"
    """`epsilon`: a random option with a decaying probability. `ucb`: the option with the highest upper bound."""
    epsilon_decisions: Annotated[NonNegativeInt, OnlyWith("exploration", "epsilon"), OwnSteps(), Schedule()] = 1000
    """Finished decisions of all environments, after the warm-up, over which the probability of a random option falls.

    It falls linearly from 1 to `epsilon_final`. Decisions of a data set do not count.
    """
    ucb_width: Annotated[NonNegativeFloat, OnlyWith("exploration", "ucb")] = 2.0
    """Width of the upper confidence bound, in standard deviations over the critics."""
    updates_per_decision: Annotated[PositiveFloat, OwnSteps()] = 0.5
    """Updates for each finished decision; with `mode=offline`, `offline.updates` counts them instead."""
    warmup_decisions: Annotated[NonNegativeInt, OwnSteps()] = 100
    """Decisions of all environments, with random options, before the first update; those of a data set do not count."""


class OptionCriticOptions(StackOptions, OptionValueOptions):
    """Settings of `OptionCritic`; an update learns from stored steps."""

    batch_size: PositiveInt = 512
    """Number of stored steps in an update."""
    buffer_size: PositiveInt = 100_000
    """Number of steps that are stored."""
    deliberation_cost: NonNegativeFloat = 0.01
    """How much better another option's return must be for the held option to end. With 0, most options end at once."""
    initial_termination: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.3
    """Probability that an untrained option ends at a step; it stays part of exploration."""
    epsilon_steps: Annotated[NonNegativeInt, Schedule()] = 20_000
    """Steps of all environments, after the warm-up, over which the probability of a random option falls.

    It falls linearly from 1 to `epsilon_final`.
    """
    updates_per_step: PositiveFloat = 0.02
    """Updates for each step, of any environment."""
    warmup_steps: NonNegativeInt = 2000
    """Steps of all environments, with random options, before the first update."""
    termination_lr: LearningRate = 1e-3
    """Learning rate of Adam for the terminations."""


class ValueOptions(Settings):
    """Settings of `Value`."""

    epsilon: Fraction = 0.05
    """Probability of a random option while exploring."""
    untried_first: bool = False
    """In sessions of trips: try each option once, in their order, before values are compared; also greedily.

    What an option shows on its first trip helps most on later trips, which the value of a trip does not count.
    """


class FixedOptions(Settings):
    """Settings of `Fixed`."""

    option: str | int = 0
    """Name or number of the option."""


CARDS = {
    "Actor": SelectorCard(options=ActorOptions, modes=("train",), takes_pictures=True, sees_state=True),
    "EpsilonGreedy": replace(BANDIT_CARD, options=EpsilonGreedyOptions),
    "Exp3": replace(BANDIT_CARD, options=Exp3Options, modes=("train",)),
    "Fixed": SelectorCard(
        options=FixedOptions,
        takes_pictures=True,
        lengths_refusal="has a setting for the option, but none for its length",
    ),
    "Human": SelectorCard(needs=("human",), takes_pictures=True),
    "LinThompson": replace(LINEAR_BANDIT_CARD, options=LinearBanditOptions),
    "LinUCB": replace(LINEAR_BANDIT_CARD, options=LinUCBOptions),
    "MetaCritic": SelectorCard(options=MetaCriticOptions, takes_pictures=True, sees_state=True, ends_options=True),
    "OptionCritic": SelectorCard(
        options=OptionCriticOptions,
        modes=("train",),
        ends_options=True,
        lengths_refusal="learns from single steps, which do not tell how long their options still last",
    ),
    "Oracle": SelectorCard(needs=("oracle",), takes_pictures=True),
    "Thompson": replace(BANDIT_CARD, options=ThompsonOptions),
    "UCB": replace(BANDIT_CARD, options=UCBOptions),
    "Uniform": SelectorCard(takes_pictures=True),
    "Value": SelectorCard(options=ValueOptions, takes_pictures=True, asks_learners=True, sees_state=True),
}
