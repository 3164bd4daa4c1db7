"""The settings and the card of H-SAC."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

from pydantic import Field, PositiveFloat, PositiveInt

from hpamdp.cards import ActionFeature
from hpamdp.policies.shared.options import (
    REPLAY_CARD,
    ActorCriticOptions,
    HeadOptions,
    InitialParameters,
    ReplayMemoryOptions,
    ScaleOptions,
    TargetRateOptions,
)
from hpamdp.settings import LearningRate, OnlyWith


class HSACOptions(HeadOptions, ReplayMemoryOptions, ActorCriticOptions, TargetRateOptions, ScaleOptions):
    """Settings of `HSAC`."""

    batch_size: PositiveInt = 256
    initial_parameters: InitialParameters = "none"
    """Initial means: `domain` takes the problem's own initial parameters, if it has any; `none` takes mid-range."""
    min_scale: PositiveFloat = 0.005
    """Smallest standard deviation of the parameters, before they are squashed to [-1, 1]."""
    discrete_temperature: PositiveFloat = 0.01
    """Weight of the discrete action's entropy in the return; if tuned, its value at the start."""
    parameter_temperature: PositiveFloat = 0.005
    """Weight of the parameters' entropy in the return; if tuned, its value at the start."""
    tune_discrete_temperature: bool = True
    """Learn the discrete temperature, so that the entropy meets `discrete_target_entropy`."""
    tune_parameter_temperature: bool = True
    """Learn the parameters' temperature, so that the entropy meets `parameter_target_entropy`."""
    discrete_target_entropy: Annotated[float, Field(ge=0.0, lt=1.0), OnlyWith("tune_discrete_temperature")] = 0.1
    """Target entropy of the discrete action, as a fraction of the uniform distribution's entropy."""
    parameter_target_entropy: Annotated[float, Field(lt=math.log(2.0)), OnlyWith("tune_parameter_temperature")] = -2.0
    """Target entropy in nats for each parameter of the executed action, where the bounds are [-1, 1].

    Uniform: 0.69. Standard deviation 0.1: -0.9; 0.03: -2.1; 0.01: -3.2.
    """
    temperature_lr: LearningRate = 1e-3
    """Learning rate of the temperatures."""
    policy_delay: PositiveInt = 2
    """Critic updates for each update of the actor and the temperatures."""
    component_samples: Annotated[int, Field(ge=2, le=64)] = 4
    """Actions sampled in each state to estimate its soft value, if an action has several components.

    With `autoregressive`, only targets use samples: the actor's loss values all choices of one component in each state.
    """


CARDS = {
    "HSAC": replace(
        REPLAY_CARD,
        options=HSACOptions,
        takes=frozenset({ActionFeature.COMPONENTS, ActionFeature.PARAMETER_BOUNDS}),
        takes_pictures=True,
        has_value=True,
    )
}
