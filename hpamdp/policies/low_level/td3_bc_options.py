"""The settings and the card of TD3+BC."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt

from hpamdp.cards import ActionFeature
from hpamdp.policies.shared.options import (
    REPLAY_CARD,
    ActorCriticOptions,
)
from hpamdp.settings import LearningRate, OnlyWith, OwnSteps, PositiveFraction, Widths


class TD3BCOptions(ActorCriticOptions):
    """Settings of `TD3BC`. Noise is in units where the parameters' bounds are [-1, 1]."""

    hidden_dims: Widths = (128, 128)
    """Hidden layers of the actor, the critics and the model of the data's discrete actions."""
    actor_lr: LearningRate = 1e-3
    """Learning rate of the actor and of the model of the data's discrete actions."""
    behaviour_weight: NonNegativeFloat = 0.2
    """Weight of the parameters' squared distance from the data, beside values divided by their mean size.

    It is 1 / alpha of the paper, which has 0.4.
    """
    discrete_threshold: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.3
    """Discrete actions are never taken if their probability in the data is below this fraction of the largest one."""
    parameter_noise: NonNegativeFloat = 0.1
    """Standard deviation of the exploring noise on the parameters."""
    target_smoothing: NonNegativeFloat = 0.05
    """Standard deviation of the noise on the parameters in the target."""
    target_smoothing_clip: Annotated[NonNegativeFloat, OnlyWith("target_smoothing")] = 0.1
    """Largest size of this noise."""
    policy_delay: PositiveInt = 2
    """Critic updates for each update of the actor and the target networks."""
    tau: PositiveFraction = 0.005
    """Fraction of the way to the learned networks that the target networks move in an update of theirs."""
    warmup_steps: Annotated[NonNegativeInt, OwnSteps()] = 1000
    """Steps before the first update."""
    batch_size: PositiveInt = 256


CARDS = {
    "TD3BC": replace(
        REPLAY_CARD,
        options=TD3BCOptions,
        takes=frozenset({ActionFeature.PARAMETER_BOUNDS}),
        has_value=True,
        explores_with=frozenset(),
    )
}
