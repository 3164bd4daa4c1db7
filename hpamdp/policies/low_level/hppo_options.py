"""The settings and the card of H-PPO."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator
from typing_extensions import Self

from hpamdp.cards import ActionFeature, LearnerCard
from hpamdp.policies.shared.options import (
    Credit,
    GreedyParameters,
    HeadOptions,
    InitialParameters,
    MemoryOptions,
    OnPolicyOptions,
)
from hpamdp.settings import Fraction, LearningRate, Schedule, ScheduleShape, Widths


class HPPOOptions(HeadOptions, MemoryOptions, OnPolicyOptions):
    """Settings of `HPPO`. Standard deviations are in units where the parameters' bounds are [-1, 1]."""

    hidden_dims: Annotated[Widths, Field(min_length=1)] = (128, 128)
    """Hidden layers that both actors share."""
    critic_hidden_dims: Annotated[Widths, Field(min_length=1)] = (128, 128)
    """Hidden layers of the critic."""
    vector_products: bool = False
    """Show actors and critic the scalar and cross products of the vectors of the plane that the problem declares."""
    initial_parameters: InitialParameters = "none"
    """Initial means: `domain` takes the problem's own initial parameters, if it has any; `none` takes mid-range."""
    initial_scale: PositiveFloat = 0.5
    """Standard deviation of the parameters at the start."""
    min_scale: PositiveFloat = 0.06
    """Smallest standard deviation at the start."""
    min_scale_final: PositiveFloat = 0.02
    """Smallest standard deviation after `anneal_steps`; the limit falls from `min_scale` to this value."""
    max_scale: PositiveFloat = 1.0
    """Largest standard deviation at the start."""
    max_scale_final: PositiveFloat | None = None
    """Largest standard deviation after `anneal_steps`; the limit falls from `max_scale` to it. If null, it stays.

    Where noise on a parameter costs little, its standard deviation stays large. Then the means are never tried alone,
    but evaluations use them alone.
    """
    epochs: Annotated[int, Field(ge=1, le=1000)] = 5
    """Passes over the collected steps in an update."""
    gamma: Fraction = 0.99
    """Discount of a step."""
    gae_lambda: Fraction = 0.95
    """Lambda of the generalised advantages: 0 bootstraps after one step, 1 at the end of the episode."""
    least_deviation: NonNegativeFloat = 0.0
    """Lower limit of the standard deviation by which advantages are divided, in the unit of the scaled rewards.

    While nothing is rewarded, all advantages are errors of the critic. Divided by their own small deviation, they move
    the policy as much as rewards would: its noise and its entropy fall before it has found anything.
    """
    reward_scale: PositiveFloat = 1.0
    """Factor on the rewards that are learned from.

    Actors and critic share `max_grad_norm`. With returns in the thousands, the critic takes nearly all of it.
    """
    lr: LearningRate = 1e-3
    """Learning rate of actors and critic at the start."""
    lr_final: Fraction = 1e-4
    """Learning rate after `anneal_steps`; it falls from `lr` to this value."""
    lr_schedule: ScheduleShape = "linear"
    """How the learning rate falls: along a line or a cosine, or not at all."""
    critic_lr: LearningRate | None = None
    """Learning rate of the critic at the start. It falls by the same factor as `lr`. If null, it is `lr`."""
    critic_epochs: Annotated[int, Field(ge=0, le=1000)] = 0
    """Further passes over the collected steps in an update, in which the critic alone learns."""
    critic_weight: PositiveFloat = 0.5
    """Weight of the critic's squared error beside the surrogates."""
    discrete_entropy: NonNegativeFloat = 0.01
    """Weight of the entropy bonus of the discrete action."""
    parameter_entropy: NonNegativeFloat = 0.0
    """Weight of the entropy bonus of the parameters."""
    entropy_final: Fraction = 0.1
    """Fraction of both entropy bonuses that is left after `anneal_steps`; they fall linearly."""
    anneal_steps: Annotated[PositiveInt, Schedule()] = 200_000
    """Steps of the whole run over which learning rate, `min_scale`, `max_scale` and entropy bonuses are annealed.

    Steps of other options' learners count, too. So a learner whose option is seldom chosen ends its exploration with
    the others, at its next update.
    """
    max_grad_norm: PositiveFloat = 1.0
    """Largest gradient norm, of actors and critic together."""
    credit: Credit = "joint"
    """Advantage of each component of an action. `joint`: the advantage of the whole action.

    `summed` and `mixed` subtract what the other components contributed to it. A critic learns the contributions, whose
    sum (`summed`) or monotonic function (`mixed`) is the advantage of the whole action.
    """
    greedy_parameters: GreedyParameters = "mean"
    """Parameters of the greedy policy. `mean`: those of the Gaussian. `clipped_mean`: the mean of its clipped samples.

    Actors learn by clipped samples. Near a bound the noise is a part of what they do: with the mean at the bound, half
    of the samples lie inside. The mean alone would stay at the bound, and the greedy agent idle.
    """
    greedy_discrete: Literal["most_probable", "sampled"] = "most_probable"
    """Discrete action of the greedy policy. `sampled` draws it, as in the published code.

    Always taking the same one of two equally good actions may lead nowhere, as turning on the spot does.
    """

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.min_scale < self.initial_scale < self.max_scale:
            raise ValueError(
                f"initial_scale={self.initial_scale}: must lie between min_scale={self.min_scale} and "
                f"max_scale={self.max_scale}"
            )
        if not self.min_scale_final < self.max_scale:
            raise ValueError(f"min_scale_final={self.min_scale_final}: must be less than max_scale={self.max_scale}")
        if self.max_scale_final is not None and not self.min_scale_final < self.max_scale_final <= self.max_scale:
            raise ValueError(
                f"max_scale_final={self.max_scale_final}: must be more than min_scale_final={self.min_scale_final} and "
                f"at most max_scale={self.max_scale}"
            )
        if self.credit != "joint" and self.autoregressive:
            raise ValueError(
                f"credit={self.credit!r}: needs autoregressive=false, as a component must not depend on "
                "the choices of the others"
            )
        if self.lr_final > self.lr:
            raise ValueError(f"lr_final={self.lr_final}: must be at most lr={self.lr}")
        return self


CARDS = {
    "HPPO": LearnerCard(
        options=HPPOOptions,
        takes=frozenset(ActionFeature),
        takes_pictures=True,
        has_value=True,
        counts_durations=True,
        explores_with=frozenset({"actions", "rewards"}),
    )
}
