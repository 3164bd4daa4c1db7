"""The settings and the card of DLPA."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator
from typing_extensions import Self

from hpamdp.cards import ActionFeature
from hpamdp.policies.shared.options import REPLAY_CARD, PlanningOptions, ReplayMemoryOptions
from hpamdp.settings import OwnSteps, PositiveFraction, Widths


class DLPAOptions(ReplayMemoryOptions, PlanningOptions):
    """Settings of `DLPA`."""

    form: Literal["parallel", "masking", "sequential"] = "masking"
    """How the model takes an action.

    `parallel`: the discrete action and its own parameters at once. `masking`: the same with the parameters of all
    actions, those of the others set to 0. `sequential`: the discrete action first, then its parameters.
    """
    hidden_dims: Widths = (128, 128)
    """Hidden layers of the transition predictor, and of each member of the ensemble for reward and termination."""
    state_weight: PositiveFloat = 2.0
    """Weight of the change of the state, in standard deviations, in the H-step loss."""
    reward_weight: PositiveFloat = 0.5
    """Weight of the reward's squared error in the H-step loss, in the units of scaled rewards.

    One network predicts rewards and terminations. With rewards much larger than 1, it learns terminations worse.
    """
    termination_weight: PositiveFloat = 0.5
    """Weight of the termination in the H-step loss."""
    rho: PositiveFraction = 0.5
    """Step h of a training window has weight rho^h."""
    buffer_size: PositiveInt = 100_000
    batch_size: PositiveInt = 256
    """Windows in an update."""
    updates_per_step: Annotated[PositiveFloat, OwnSteps()] = 1.0
    """Updates for each step that the learner collects; the first ones make up for the warm-up."""
    momentum: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.1
    """Weight of the old distribution in the new one."""
    pessimism: NonNegativeFloat = 0.0
    """Standard deviations between the members' returns that are subtracted from their mean.

    With two members, 1 gives their minimum.
    """

    @model_validator(mode="after")
    def _check_dlpa(self) -> Self:
        self._check_search(("num_samples",), ("horizon", "num_iterations"))
        return self


CARDS = {
    "DLPA": replace(
        REPLAY_CARD,
        options=DLPAOptions,
        takes=frozenset({ActionFeature.COMPONENTS, ActionFeature.PARAMETER_BOUNDS}),
        has_value=True,
        value_setting="end_values",
        counts_durations=False,
        novelty_by="plan",
    )
}
