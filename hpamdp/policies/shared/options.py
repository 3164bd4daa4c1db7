"""Settings that several selectors or learners share; their classes derive from these."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator
from typing_extensions import Self

from hpamdp.cards import LearnerCard
from hpamdp.settings import (
    Expectile,
    Fraction,
    LearningRate,
    OnlyWith,
    OwnSteps,
    PositiveFraction,
    Schedule,
    ScheduleShape,
    Settings,
    Widths,
)


class StackOptions(Settings):
    """Settings of a memory of the last observations."""

    memory: Literal["none", "stack"] = "none"
    """What the networks see beside the observation. `none`: nothing; `stack`: the observations before it.

    A selector sees those at its decisions.
    """
    stack_steps: Annotated[int, Field(ge=2, le=1000), OnlyWith("memory", "stack")] = 4
    """With `memory=stack`: number of observations that the networks see, the current one included.

    Zeros stand for observations before the first one.
    """

    @model_validator(mode="after")
    def _check_memory(self) -> Self:
        for name in ("vector_products", "augment"):  # problems declare vectors and symmetries of observations alone
            if self.memory != "none" and getattr(self, name, False) is True:
                raise ValueError(f"{name}=true: does not go with memory={self.memory}; use {name}=false or memory=none")
        return self


class MemoryOptions(StackOptions):
    """Settings of a memory."""

    memory: Literal["none", "stack", "gru"] = "none"  # type: ignore[assignment]
    """What the networks see beside the observation. `none`: nothing; `stack`: the observations before it.

    `gru`: the state of a GRU that has seen all observations since the memory was reset. A selector sees those at its
    decisions.
    """
    memory_size: Annotated[PositiveInt, OnlyWith("memory", "gru")] = 64
    """With `memory=gru`: units of the GRU."""
    sequence_length: Annotated[PositiveInt, OnlyWith("memory", "gru")] = 16
    """With `memory=gru`: steps, for selectors decisions, through which gradients flow back in time."""


class ReplayMemoryOptions(MemoryOptions):
    """Settings of a memory that learns from a replay buffer."""

    burn_in: Annotated[NonNegativeInt, OnlyWith("memory", "gru")] = 8
    """With `memory=gru`: steps, for selectors decisions, before each sequence, replayed without gradients.

    From them the current GRU computes the state in which the sequence starts.
    """


class OnPolicyOptions(Settings):
    """Settings of proximal policy optimisation."""

    epochs: Annotated[int, Field(ge=1, le=1000)] = 10
    """Passes over the collected rows in an update."""
    minibatch_size: PositiveInt = 256
    """Rows in a gradient step, and the least number of rows that an update waits for."""
    clip: PositiveFloat = 0.2
    """The surrogate stops rewarding probability ratios that are further from 1 than this."""
    lr: LearningRate = 3e-4
    """Learning rate of Adam."""
    max_grad_norm: PositiveFloat = 0.5
    """Largest gradient norm of a gradient step; longer gradients are scaled down.

    `high=actor` limits the norms of its policy, its critic and their common perception separately.
    """


class BufferOptions(Settings):
    """Settings of a replay buffer."""

    buffer_size: PositiveInt = 200_000
    """Capacity of the replay buffer, in steps; the oldest steps are overwritten."""
    batch_size: PositiveInt = 128
    """Transitions in an update."""

    @model_validator(mode="after")
    def _check_buffer(self) -> Self:
        if self.batch_size > self.buffer_size:
            raise ValueError(f"batch_size={self.batch_size}: must be at most buffer_size={self.buffer_size}")
        return self


class OptionValueOptions(BufferOptions):
    """Settings of option values that are learned from a replay buffer."""

    hidden_dims: Widths = (128, 128)
    """Hidden layers of each network."""
    gamma: PositiveFraction = 0.99
    """Discount of an environment step, both within an option's return and for what follows the option."""
    epsilon_final: Annotated[Fraction, OwnSteps()] = 0.1
    """Probability of a random option at the end of its linear decay from 1."""
    buffer_size: PositiveInt = 50_000
    """Number of decisions, or of steps, that are stored. Old ones mislead, since the learners improve."""
    batch_size: PositiveInt = 128
    """Number of stored decisions, or of steps, in an update."""
    max_updates: Annotated[PositiveInt, OwnSteps()] = 64
    """Largest number of updates between two collected batches."""
    lr: LearningRate = 1e-3
    """Learning rate of Adam for the option values."""
    tau: PositiveFraction = 0.01
    """Fraction of the way to the learned network that the target network moves after each update."""


# `joint`: every component gets the whole advantage. Otherwise the branches of a `CreditCritic` are summed or mixed.
Credit = Literal["joint", "summed", "mixed"]


class HeadOptions(Settings):
    """How the components of an action depend on each other."""

    autoregressive: bool = False
    """Let each component of an action see the choices of the components before it.

    If false, the components are independent given the state.
    """


class ScaleOptions(Settings):
    """The range in which the standard deviation of the parameters is learned."""

    min_scale: PositiveFloat = 0.02
    """Smallest standard deviation of the parameters, in units where their bounds are [-1, 1]."""
    max_scale: PositiveFloat = 1.0
    """Largest standard deviation of the parameters."""

    @model_validator(mode="after")
    def _check_scale(self) -> Self:
        if not self.min_scale < self.max_scale:
            raise ValueError(f"min_scale={self.min_scale}: must be less than max_scale={self.max_scale}")
        return self

    @property
    def scale_range(self) -> tuple[float, float]:
        """Smallest and largest standard deviation."""
        return self.min_scale, self.max_scale


# Initial parameters: the problem's own convention, if it has one (`domain`), or the network's initial output (`none`).
InitialParameters = Literal["domain", "none"]
# Greedy parameters of a Gaussian policy: its mean, or the mean of its samples after they are clipped to the bounds.
GreedyParameters = Literal["mean", "clipped_mean"]


class EpsilonOptions(Settings):
    """Exploration by noise on the parameters and by random actions."""

    parameter_noise: NonNegativeFloat = 0.1
    """Standard deviation of the exploring noise on the parameters, in units where their bounds are [-1, 1]."""
    epsilon_final: Annotated[Fraction, OwnSteps()] = 0.05
    """Probability of a random action after `epsilon_steps`; it falls linearly from 1 to this value."""
    epsilon_steps: Annotated[NonNegativeInt, OwnSteps(), Schedule()] = 40_000
    """The learner's own steps, after its warm-up, within which the probability of a random action falls."""


class ReplayOptions(BufferOptions):
    """Settings of a learner with a replay buffer."""

    warmup_steps: Annotated[NonNegativeInt, OwnSteps()] = 5000
    """Random steps of a learner before its first update."""
    updates_per_step: Annotated[PositiveFloat, OwnSteps()] = 0.25
    """Updates for each step that the learner collects."""
    augment: Literal["auto"] | bool = False
    """Map each sampled transition by a random symmetry that the problem declares.

    `auto` does so if there is any and the learner has no memory.
    """
    gamma: PositiveFraction = 0.99
    """Discount of a step."""
    reward_scale: PositiveFloat = 1.0
    """Factor on the stored rewards. It scales values and predicted rewards, too."""

    @model_validator(mode="after")
    def _check_replay(self) -> Self:
        if self.updates_per_step > 1000.0:
            raise ValueError(f"updates_per_step={self.updates_per_step}: must be at most 1000")
        return self


class ActorCriticOptions(ReplayOptions):
    """Settings of an actor and its critics, which learn from a replay buffer."""

    hidden_dims: Widths = (128, 128)
    """Hidden layers of the actor and of the critics."""
    actor_lr: LearningRate = 1e-3
    """Learning rate of the actor."""
    critic_lr: LearningRate = 1e-3
    """Learning rate of the critics."""


class TargetRateOptions(Settings):
    """How fast target networks follow the learned networks."""

    tau: PositiveFraction = 0.01
    """Fraction of the way to the learned networks that the target networks move in an update of theirs."""


class SearchingActorOptions(EpsilonOptions, ActorCriticOptions):
    """Settings of a deterministic actor that may search for better actions, and of its critics."""

    twin: bool = True
    """Learn two critics and use the lower of their values. A single critic overestimates."""
    target_smoothing: NonNegativeFloat = 0.1
    """Standard deviation of the noise on the target actor's output, in units where its bounds are [-1, 1]."""
    target_smoothing_clip: Annotated[NonNegativeFloat, OnlyWith("target_smoothing")] = 0.2
    """Largest size of this noise."""
    policy_delay: PositiveInt = 2
    """Critic updates for each update of the actor."""
    lr_final_fraction: Annotated[PositiveFraction, OwnSteps()] = 1.0
    """Fraction of the learning rates that is left after `lr_steps`; 1 keeps them constant."""
    lr_schedule: ScheduleShape = "linear"
    """How the learning rates fall: along a line or a cosine, or not at all."""
    lr_steps: Annotated[NonNegativeInt, OwnSteps(), Schedule()] = 100_000
    """The learner's own steps, after its warm-up, within which the learning rates fall.

    With `mode=offline` the learner makes no steps of its own, so the rates stay constant.
    """
    layer_norm: bool = False
    """Normalise the critics' layers, which bounds the values of actions far from all that were tried."""
    preactivation_penalty: NonNegativeFloat = 0.0
    """Weight of the squared preactivations of tanh in the actor's loss.

    Where tanh has brought an action to its bound, gradients no longer move it; the penalty does, towards the middle.
    """
    search_samples: NonNegativeInt = 0
    """Random actions for each discrete action that an update of the actor values with the critics; 0 is no search."""
    search_weight: Annotated[NonNegativeFloat, OnlyWith("search_samples")] = 0.1
    """Weight of the distance to the best of these actions in the actor's loss, times its gain in value."""
    greedy_samples: NonNegativeInt = 0
    """Variations of the actor's actions from which the greedy policy takes the one with the highest value."""
    greedy_noise: Annotated[NonNegativeFloat, OnlyWith("greedy_samples")] = 0.3
    """Standard deviation of these variations, in units where the bounds are [-1, 1]."""

    @model_validator(mode="after")
    def _check_schedule(self) -> Self:
        if self.lr_schedule == "cosine" and self.lr_final_fraction == 1.0:
            raise ValueError("lr_schedule=cosine: needs lr_final_fraction below 1")
        return self


class EndValueOptions(Settings):
    """Settings of the values at the ends of plans."""

    end_values: bool = False
    """Let plans count the value of their last state, by networks that learn it from the stored steps.

    Set it if options end inside episodes, and for `high=value`: a plan of one option does not see the rewards of the
    next one. Set it also if all rewards are the same and the terminations are further away than the horizon.
    """
    end_value_lr: Annotated[LearningRate, OnlyWith("end_values")] = 1e-3
    """Learning rate of these values."""
    end_value_tau: Annotated[PositiveFraction, OnlyWith("end_values")] = 0.02
    """Fraction of the way to the learned values that their target network moves at each update."""
    end_value_expectile: Annotated[Expectile, OnlyWith("end_values")] = 0.9
    """Expectile of the returns that stored actions led to, from 0.5, their mean, towards 1, the best of them."""


class SearchOptions(Settings):
    """Settings of a search for good sequences of actions. Deviations are in units where the bounds are [-1, 1]."""

    horizon: PositiveInt = 2
    """Steps in a sequence: a plan sees no reward and no termination beyond them."""
    num_samples: PositiveInt = 256
    """Samples in an iteration."""
    num_elites: PositiveInt = 32
    """The best of the samples, which define the next iteration's distribution."""
    num_iterations: PositiveInt = 5
    """Iterations of the search."""
    temperature: PositiveFloat = 0.1
    """Elites are weighted by exp(return / (temperature * spread)), so the scale of rewards does not matter.

    The spread is the standard deviation of the returns of the plan's first samples.
    """
    min_deviation: NonNegativeFloat = 0.02
    """Smallest standard deviation of a parameter."""

    def _check_search(self, samples: Sequence[str], factors: Sequence[str]) -> None:
        """Refuse more elites than samples, and searches that try too many actions.

        Args:
            samples: names of the settings that are numbers of samples.
            factors: names of the other settings. Times the samples, their product is the number of actions tried.
        """
        for name in samples:
            if self.num_elites > getattr(self, name):
                raise ValueError(f"num_elites={self.num_elites}: must be at most {name}={getattr(self, name)}")
        most = max(getattr(self, name) for name in samples)
        if most * math.prod(getattr(self, name) for name in factors) > 1_000_000_000:
            given = ", ".join(f"{name}={getattr(self, name)}" for name in (*factors, *samples))
            raise ValueError(f"{given}: a plan would try more than 1,000,000,000 actions")


class SequenceSearchOptions(SearchOptions):
    """Settings of a `SequenceSearch`."""

    max_sequences: PositiveInt = 64
    """Largest number of discrete sequences tried: all of them if there are no more, else random ones."""
    num_kept: PositiveInt = 4
    """Sequences refined in the second iteration; half as many in each one after it, down to 1."""
    num_samples: PositiveInt = 12
    """Samples of the parameters for each sequence in an iteration."""
    greedy_samples: PositiveInt = 60
    """`num_samples` of a greedy plan. Greedy plans need more, because no exploration corrects them."""
    num_elites: PositiveInt = 4
    """The best of the samples, which define the next iteration's Gaussians."""
    first_min_deviation: NonNegativeFloat = 0.3
    """Smallest standard deviation of a parameter in the second iteration; it falls geometrically from there.

    The shortest step that reaches a target lies at a cliff of the return, which elites alone approach too slowly.
    """
    min_deviation: NonNegativeFloat = 0.04
    """Smallest standard deviation of a parameter in the last iteration.

    With two iterations `first_min_deviation` counts.
    """

    @model_validator(mode="after")
    def _check_sequences(self) -> Self:
        self._check_search(("num_samples", "greedy_samples"), ("horizon", "max_sequences", "num_iterations"))
        if self.min_deviation > self.first_min_deviation:
            raise ValueError(
                f"min_deviation={self.min_deviation}: must be at most first_min_deviation={self.first_min_deviation}"
            )
        return self


class PlanningOptions(SearchOptions, EndValueOptions, ReplayOptions):
    """Settings of a learner that plans in a learned model."""

    warmup_steps: Annotated[PositiveInt, OwnSteps()] = 1000
    """Random steps of a learner before its first update. The updates that are due for them are then made at once."""
    num_members: PositiveInt = 2
    """Members of the ensemble of models."""
    lr: LearningRate = 1e-3
    """Learning rate of the model."""
    epsilon: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.05
    """Probability of a uniformly random action in place of an exploring plan's."""
    planning_precision: Literal["float32", "bfloat16"] = "bfloat16"
    """Precision of the networks' hidden layers when planning; `update_precision` is that of updates.

    bfloat16 is faster on hardware with instructions for it (AVX-512 BF16, AMX, GPUs) and slower elsewhere.
    """


# Learners with a replay buffer count durations, learn from data sets, and take any exploration.
REPLAY_CARD = LearnerCard(
    modes=("train", "offline"),
    counts_durations=True,
    explores_with=frozenset({"actions", "rewards"}),
    novelty_by="sample",
)
