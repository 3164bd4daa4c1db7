"""The settings and the cards of Goal and Hard Goal."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemFacts, ProblemOptions
from hpamdp.settings import FromList

ACTIONS = ("kick to", "shoot left", "shoot right")
HARD_GOAL_ACTIONS = ("kick to", *(f"shoot {side} {stretch}" for side in ("left", "right") for stretch in range(1, 6)))
Slip = Literal["kick_to", "goal_distance", "keeper_projection"]
HardSlip = Literal["kick_to", "goal_distance", "keeper_projection", "middle_shots"]


class GoalOptions(ProblemOptions):
    """Settings of `GoalEnv`."""

    max_steps: PositiveInt = 100
    """Steps after which an episode ends. The last one is not played, as in the published code."""
    limit: Literal["truncated", "terminated"] = "truncated"
    """If `terminated`, values stop at the time limit, as in the published code; if `truncated`, they bootstrap past it.

    The observation does not show the time, and the limit costs the ball's distance from the goal.
    """
    observation: Literal["scaled", "raw"] = "scaled"
    """`scaled` to [-1, 1], which orientations and the ball can leave, or `raw` positions, velocities and angles."""
    noise: Annotated[float, Field(ge=0.0, le=5.0)] = 1.0
    """Factor on the published noise of all motions; 0 means no noise. From about 10 on, an action might never end."""
    repaired: Annotated[tuple[Slip, ...], FromList] = ()
    """Slips of the published code to take out. With any of them, scores do not compare with published ones.

    `kick_to`: a kick to (x, y) goes to (x, x), so that y is never read. `goal_distance`: below the goal and behind its
    line, the distance is 14.02 too large. `keeper_projection`: this entry of the observation is clipped to
    [-7.01, 14.02] instead of [-7.01, 7.01].
    """

    @property
    def discrete_names(self) -> tuple[str, ...]:
        """The names of the discrete actions."""
        return ACTIONS

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem; the default options are `carry` and `shoot`."""
        groups = {"carry": self.discrete_names[:1], "shoot": self.discrete_names[1:]}
        return ProblemFacts(title=title, default_options=groups)


class HardGoalOptions(GoalOptions):
    """Settings of `HardGoalEnv`."""

    repaired: Annotated[tuple[HardSlip, ...], FromList] = ()  # type: ignore[assignment]
    """Slips of the published code to take out, those of Goal and `middle_shots`.

    `middle_shots`: the middle stretch is a single point, y = 1.402, and not [-1.402, 1.402], so that no shot goes to
    the middle of the goal.
    """

    @property
    def discrete_names(self) -> tuple[str, ...]:
        """The names of the discrete actions."""
        return HARD_GOAL_ACTIONS


CARDS = {
    "GoalEnv": ProblemCard(options=GoalOptions),
    "HardGoalEnv": ProblemCard(options=HardGoalOptions),
}
