"""The settings and the card of PETS."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from hpamdp.cards import ActionFeature
from hpamdp.policies.shared.options import (
    REPLAY_CARD,
    PlanningOptions,
    ReplayMemoryOptions,
    SequenceSearchOptions,
)
from hpamdp.settings import Fraction, OwnSteps, Widths


class PETSOptions(SequenceSearchOptions, PlanningOptions, ReplayMemoryOptions):
    """Settings of `PETS`."""

    weight_decay: NonNegativeFloat = 1.0
    """Weight decay of AdamW. With much less, the networks overfit a few hundred steps, with overconfident errors."""
    weight_decay_steps: PositiveInt = 256
    """With more stored steps than these, the decay falls as 1 / steps, so that it blurs no edges of targets."""
    transition_weight: PositiveFloat = 2.0
    """Weight of the change's error in the loss; those of termination and rewards are 1."""
    warmup_steps: Annotated[PositiveInt, OwnSteps()] = 64
    """Random steps of a learner before its first update; there are more until two rewards differ."""
    updates_per_step: Annotated[PositiveFloat, OwnSteps()] = 10.0
    """Updates for each step that the learner collects; the first ones make up for the warm-up."""
    batch_size: PositiveInt = 64
    """Steps in a member's minibatch."""
    buffer_size: PositiveInt = 50_000
    augment: Literal["auto"] | bool = "auto"
    """Use the symmetry and the geometry that the problem declares: `auto` if there are any; true requires them."""
    num_members: PositiveInt = 5
    """Models, each trained on minibatches of its own."""
    transition_dims: Widths = (64, 64)
    """Hidden layers of the networks that predict the change of the state."""
    outcome_dims: Widths = (64, 64)
    """Hidden layers of the networks that predict whether a step terminates, and its reward."""
    probabilistic: bool = False
    """Predict a variance of the change, for problems with noise."""
    linear_part: Literal["auto"] | bool = "auto"
    """Predict the change by a linear model, fitted by least squares, plus what the networks add to it.

    The linear model knows where steps lead after some hundred steps. `auto` uses it unless the problem declares a
    geometry that makes its discrete actions alike.
    """
    posterior_sampling: Literal["auto"] | bool = "auto"
    """Let each exploring environment follow the plans of one member until its episode or option ends.

    So environments try what members disagree on. If false, plans use all members. With a bonus for new states, plans
    always use all members.

    `auto` does so if the problem declares a geometry that makes its discrete actions alike. Elsewhere a single member
    knows too little for its plans to lead anywhere.
    """
    optimism: NonNegativeFloat = 1.0
    """Without posterior sampling: standard deviations of the members' returns that exploring plans add to the mean."""
    caution: NonNegativeFloat = 0.0
    """Standard deviations of the members' returns that greedy plans subtract from the mean.

    It avoids plans that look good only because some members err. This helps where one mistake ends the episode.
    """
    hypotheses: NonNegativeInt = 8
    """Number of sampled sets of directions to plan under while some actions' directions are unknown.

    Plans then value what an action reveals. If 0, or if there are more than `max_sequences` sequences of horizon + 1
    discrete actions, plans use a single guess.
    """
    parameter_noise: NonNegativeFloat = 0.05
    """Standard deviation of the exploring noise on the parameters, in units where their bounds are [-1, 1]."""
    epsilon: Fraction = 0.0
    """Probability of a uniformly random action in place of an exploring plan's.

    If no member has seen a reward, all of them predict none, and planning alone never finds it.
    """


CARDS = {
    "PETS": replace(
        REPLAY_CARD,
        options=PETSOptions,
        takes=frozenset({ActionFeature.COMPONENTS, ActionFeature.PARAMETER_BOUNDS}),
        has_value=True,
        remembers_directions=True,
        counts_durations=False,
        novelty_by="plan",
        knows_disagreement=True,
    )
}
