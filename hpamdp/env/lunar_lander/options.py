"""The settings and the card of Hybrid LunarLander."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemFacts, ProblemOptions
from hpamdp.settings import OnlyWith, PositiveFraction, Settings


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


class LunarLanderOptions(LanderRules, ProblemOptions):
    """Settings of `LunarLanderEnv`."""

    max_steps: PositiveInt = 1000
    """Steps after which an episode is truncated."""
    render: bool = False
    """Draw the lander, for films; steps then take longer."""
    reward_scaling: PositiveFraction | None = None
    """Divide rewards in training by the running standard deviation of the return with this discount.

    If null, rewards are not scaled.
    """
    num_workers: NonNegativeInt = 0
    """Processes that step the environments in parallel. If 0, this process steps them."""

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem, which errors call `title`."""
        return ProblemFacts(
            title=title, is_shardable=self.num_workers == 0, has_statistics=self.reward_scaling is not None
        )


CARDS = {
    "LunarLanderEnv": ProblemCard(options=LunarLanderOptions),
}
