"""The settings and the card of Hybrid LunarLander."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, NonNegativeFloat, PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.gymnasium.options import SimulatorOptions
from hpamdp.settings import OnlyWith, Settings


class LanderRules(Settings):
    """Settings of `HybridLunarLander`."""

    gravity: Annotated[float, Field(gt=-12.0, lt=0.0)] = -10.0
    """Gravity in Box2D's units, negative downwards."""
    enable_wind: bool = False
    """Whether wind pushes and turns the lander, with a strength that changes from step to step."""
    wind_power: Annotated[NonNegativeFloat, OnlyWith("enable_wind")] = 15.0
    """With `enable_wind`: largest force of the wind."""
    turbulence_power: Annotated[NonNegativeFloat, OnlyWith("enable_wind")] = 1.5
    """With `enable_wind`: largest torque of the wind."""


class LunarLanderOptions(SimulatorOptions, LanderRules):
    """Settings of `LunarLanderEnv`."""

    max_steps: PositiveInt = 1000
    """Steps after which an episode is truncated."""


CARDS = {
    "LunarLanderEnv": ProblemCard(options=LunarLanderOptions),
}
