"""The settings and the card of PADDPG."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from hpamdp.cards import ActionFeature
from hpamdp.policies.shared.options import (
    REPLAY_CARD,
    ActorCriticOptions,
    EpsilonOptions,
    InitialParameters,
    TargetRateOptions,
)
from hpamdp.settings import LearningRate, OnlyWith


class PADDPGOptions(ActorCriticOptions, TargetRateOptions, EpsilonOptions):
    """Settings of `PADDPG`. Noise is in units where the bounds of scores and parameters are [-1, 1]."""

    twin: bool = False
    """Train as in TD3, which makes it PATD3: the lower of two critics counts, with smoothing and a delayed actor."""
    target_smoothing: Annotated[NonNegativeFloat, OnlyWith("twin")] = 0.1
    """With `twin`: standard deviation of the noise on scores and parameters in the target; 0 adds no noise."""
    target_smoothing_clip: Annotated[NonNegativeFloat, OnlyWith("twin"), OnlyWith("target_smoothing")] = 0.2
    """With `twin`: largest size of this noise."""
    policy_delay: Annotated[PositiveInt, OnlyWith("twin")] = 2
    """With `twin`: critic updates for each update of the actor and the target networks."""
    initial_parameters: InitialParameters = "domain"
    """`domain` adds the problem's own initial parameters, if it has any, by a frozen layer; `none` adds nothing."""
    actor_lr: LearningRate = 1e-4
    max_grad_norm: PositiveFloat | None = 10.0
    """Largest gradient norm. If null, no limit."""
    parameter_noise: NonNegativeFloat = 0.1
    """Standard deviation of the exploring noise on scores and parameters."""
    augment: Literal[False] = False
    """Always false: the symmetries of a problem map no scores."""


CARDS = {
    "PADDPG": replace(
        REPLAY_CARD,
        options=PADDPGOptions,
        modes=("train",),
        takes=frozenset({ActionFeature.COMPONENTS, ActionFeature.PARAMETER_BOUNDS}),
        has_value=True,
    )
}
