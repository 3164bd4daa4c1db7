"""The settings and the card of primitives."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.gymnasium.options import SimulatorOptions
from hpamdp.env.primitives.primitives import LARGE_POSITION_STEPS, PRIMITIVES, SMALL_POSITION_STEPS, Action
from hpamdp.settings import OnlyWith, Settings

Task = Literal["drawer_close", "soccer", "peg_unplug_side", "sweep_into", "assembly", "disassemble"]
Actions = Literal["primitives", "small_steps", "large_steps", "all"]
Reward = Literal["dense", "sparse"]
ACTIONS: dict[str, tuple[Action, ...]] = {
    "primitives": PRIMITIVES,
    "small_steps": SMALL_POSITION_STEPS,
    "large_steps": LARGE_POSITION_STEPS,
    "all": PRIMITIVES + SMALL_POSITION_STEPS + LARGE_POSITION_STEPS,
}
_GROUPED_PRIMITIVES = {
    "move": ["move", "open"],
    "grasp": ["grasp", "close"],
    "pull": ["lift", "drop", "left", "right", "forward", "backward"],
}


class ManipulationRules(Settings):
    """Settings of `Manipulation`."""

    task: Task = "drawer_close"
    """Meta-World's task."""
    reward: Reward = "sparse"
    """`sparse`: 1 for each primitive with a success in it; `dense`: the mean of Meta-World's rewards in it, 0 to 10."""
    decisions: PositiveInt = 5
    """Primitives in an episode; 60 small or 6 large position steps take as long as one."""
    actions: Actions = "primitives"
    """What the agent chooses from: `primitives`, `small_steps` (up to 1 cm), `large_steps` (up to 10 cm), or `all`."""
    reach: Annotated[float, Field(gt=0.0, le=1.0), OnlyWith("actions", "primitives", "all")] = 1.0
    """Largest absolute value of a primitive's argument, in metres."""
    negative_distances: Annotated[bool, OnlyWith("actions", "primitives", "all")] = True
    """Whether primitives along one axis also take distances below 0, which count as 0, as in the source."""


class PrimitivesOptions(SimulatorOptions, ManipulationRules):
    """Settings of `PrimitivesEnv`."""

    render: bool = False
    """Draw the arm, for films; without a display MuJoCo needs MUJOCO_GL=egl or osmesa."""

    @property
    def default_options(self) -> dict[str, list[int | str]]:
        """The kinds of primitives, or with `actions=all` the ways of steering."""
        if self.actions == "all":
            ways = ("small_steps", "large_steps", "primitives")
            return {way: [action.name for action in ACTIONS[way]] for way in ways}
        groups = _GROUPED_PRIMITIVES if self.actions == "primitives" else {}
        return {name: [*members] for name, members in groups.items()}


CARDS = {
    "PrimitivesEnv": ProblemCard(options=PrimitivesOptions),
}
