"""The settings and the card of sessions with unknown boats."""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, model_validator
from typing_extensions import Self

from hpamdp.cards import ProblemCard
from hpamdp.env.boatdock.task import DOCKING_SPEED, RewardForm, speed
from hpamdp.env.facts import ProblemFacts, ProblemOptions
from hpamdp.settings import OnlyWith

Family = Literal["turned", "any", "strength"]
FAMILIES: tuple[Family, ...] = ("turned", "any", "strength")
MOST_TRIPS = 24
BOAT_NAMES = ("boat_1", "boat_2")


class FleetRules(NamedTuple):
    """The boats that sessions draw from. The settings of UnseenBoatsEnv explain the fields."""

    family: Family = "turned"
    separation: float = math.radians(60.0)  # radians
    spread: float = 0.3


class UnseenBoatsOptions(ProblemOptions):
    """Settings of `UnseenBoatsEnv`."""

    trips: Annotated[int, Field(ge=1, le=MOST_TRIPS)] = 8
    """Trips of a session, each with a layout and a full tank of its own."""
    boats: Literal[1, 2] = 1
    """Boats of a session. With 2 the agent chooses one at a trip's first press, and keeps it for the trip."""
    family: Family = "turned"
    """What boats differ in. `turned`: people's three directions, turned by any angle, with the keys in any order.

    `any`: any three directions that are `separation` apart. `strength`: as `turned`, and speed and glide differ, too.
    """
    separation: Annotated[float, Field(ge=0.0, le=110.0), OnlyWith("family", "any")] = 60.0
    """With `family=any`: least angle between two directions, in degrees."""
    spread: Annotated[float, Field(ge=0.0, le=0.5), OnlyWith("family", "strength")] = 0.3
    """With `family=strength`: speed and glide are up to this fraction above or below those of people's boats."""
    fleet_size: Annotated[int, Field(ge=1, le=2**24)] | None = None
    """Number of different boats in training. If null, each session draws new ones."""
    fleet_seed: Annotated[int, Field(ge=0, lt=2**32), OnlyWith("fleet_size")] = 0
    """With a `fleet_size`: which boats these are."""
    scored_boats: Literal["new", "training"] = "new"
    """Boats of evaluations: `new` ones, which no training meets, or with a `fleet_size` those of `training`."""
    shortest_press: Annotated[float, Field(ge=0.0, le=1.0)] = 0.15
    """Seconds of the shortest press; the default is the fifth percentile of people's presses.

    Shorter presses would show where the keys push at almost no cost.
    """
    reward: RewardForm = "paper"
    """`paper`: progress at each press, 5 x the fuel left on success, -1 on failure. `sparse`: only the success term."""
    frame: Literal["screen", "first_press"] = "screen"
    """Axes of positions, displacements and velocities that are seen: the screen's, or those of the first press.

    With `first_press` the x axis points to where the session's first press moved the boat, as far as it was seen. Until
    then it points from the start to the goal. So turned boats look alike, and only the order of the keys is unknown.
    With two boats this holds for the one that was pressed first.
    """
    motor_noise: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0
    """Standard deviation of the log of the executed duration."""
    sensor_noise: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    """Standard deviation of the positions and of the displacement that are seen, in pixels.

    The velocity and the seconds of the last press are seen without noise, so they still show where its key pushes.
    """

    @model_validator(mode="after")
    def _check_fleet(self) -> Self:
        if self.fleet_size is None and self.scored_boats == "training":
            raise ValueError(
                "scored_boats=training: needs a fleet_size; without one training draws new boats each time"
            )
        if self.fleet_size is not None and self.fleet_size < self.boats:
            raise ValueError(f"fleet_size={self.fleet_size}: a session has boats={self.boats}, so it needs as many")
        strongest = 1.0 + (self.spread if self.family == "strength" else 0.0)
        fastest = strongest * speed(self.shortest_press)
        if fastest > DOCKING_SPEED:
            raise ValueError(
                f"shortest_press={self.shortest_press:g}: it leads to {fastest:.0f} px/s, but boats dock at no more "
                f"than {DOCKING_SPEED:g} px/s"
            )
        return self

    @property
    def fleet(self) -> FleetRules:
        """The boats that sessions draw from."""
        return FleetRules(self.family, math.radians(self.separation), self.spread)

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem, which errors call `title`."""
        has_choice = self.boats > 1
        return ProblemFacts(
            title=title,
            option_names=BOAT_NAMES if has_choice else (),
            has_choice=has_choice,
            can_change_option=False,
        )


CARDS = {
    "UnseenBoatsEnv": ProblemCard(
        options=UnseenBoatsOptions,
        has_trips=True,
        choice_setting="env.boats=2",
        no_choice_setting="env.boats=1",
    )
}
