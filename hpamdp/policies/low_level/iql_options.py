"""The settings and the card of IQL."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from hpamdp.cards import ActionFeature
from hpamdp.policies.shared.options import REPLAY_CARD, ActorCriticOptions, HeadOptions, ScaleOptions
from hpamdp.settings import Expectile, LearningRate, OwnSteps, PositiveFraction, Schedule, Widths


class IQLOptions(HeadOptions, ActorCriticOptions, ScaleOptions):
    """Settings of `IQL`."""

    hidden_dims: Annotated[Widths, Field(min_length=1)] = (128, 128)
    """Hidden layers of the actor, the state value and the critics."""
    actor_lr_updates: Annotated[NonNegativeInt, Schedule()] = 0
    """Updates within which the actor's learning rate falls to 0 along a cosine; with 0 it is constant."""
    critic_lr: LearningRate = 1e-3
    """Learning rate of the critics and of the state value."""
    tau: PositiveFraction = 0.005
    """Fraction of the way to the learned critics that the target critics move in an update."""
    warmup_steps: Annotated[NonNegativeInt, OwnSteps()] = 1000
    """Steps before the first update; the policy explores by its own standard deviation."""
    batch_size: PositiveInt = 256
    expectile: Expectile = 0.8
    """Expectile of the actions' values that V estimates: 0.5 is their mean, 1 their maximum."""
    temperature: PositiveFloat = 10.0
    """An action has weight exp(temperature * advantage) in the policy's likelihood.

    If advantages are much larger than 1 / `temperature`, most weights are near 0 or equal `max_weight`. Then reduce
    `reward_scale`.
    """
    max_weight: PositiveFloat = 100.0
    """Largest weight of an action."""


CARDS = {
    "IQL": replace(
        REPLAY_CARD, options=IQLOptions, takes=frozenset(ActionFeature), has_value=True, explores_with=frozenset()
    )
}
