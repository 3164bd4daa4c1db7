"""What the task is made of: lengths, times, names, the settings and the state of boats; nothing here needs torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

HARBOUR_RADIUS = 120.0
DOCK_RADIUS = 15.0
GLIDE = 0.95  # length and duration of the glide, as multiples of those of the pressed stretch
DOCKING_SPEED = 74.0  # px/s, the highest speed of arrival that docks
TANK = 6.0  # seconds of pressing in a full tank
MAX_DURATION = 2.0  # seconds


def speed(duration: Any) -> Any:
    """Return the speed (px/s) after pressing for `duration` seconds from rest: a number, an array or a tensor."""
    return duration * duration * (100.0 - (20.0 / 3.0) * duration)


# Going on, success, the failures, and the time limit at the end. `physics` and `kernel` decide among them.
OUTCOMES = ("sailing", "success", "too_fast", "out_of_bounds", "out_of_fuel", "time_limit")
SAILING, SUCCESS, TOO_FAST, OUT_OF_BOUNDS, OUT_OF_FUEL, TIME_LIMIT = range(len(OUTCOMES))

# With less fuel than this (seconds) the tank counts as empty: the rest is rounding in float32.
DRY = 1e-6

CENTRE = (640.0, 512.0)  # px on the screen
LAYOUT_RADIUS = 110.0
MIN_SEPARATION = 30.0
NUM_KEYS = 3

INCONGRUENT, CONGRUENT = 0, 1
CONTROLLERS = ("incongruent", "congruent")  # option 0, option 1
NOT_CHOSEN = -1

# Controllers that `boats` may name: the degrees in which each key pushes, 0 to the right, 90 down. People's incongruent
# boat had one of two key maps, which are two controllers here.
CONTROLLER_DEGREES: dict[str, tuple[float, ...]] = {
    "congruent": (150.0, 270.0, 30.0),
    "incongruent1": (330.0, 210.0, 90.0),
    "incongruent2": (90.0, 330.0, 210.0),
}

# Indices of an episode's random numbers: three for each try at a layout, then the others.
LAYOUT_TRIES = 4
INDEX_ANGLE = 3 * LAYOUT_TRIES
INDEX_CONTROLLER = 3 * LAYOUT_TRIES + 1
INDEX_KEYMAP = 3 * LAYOUT_TRIES + 2

MAX_PRESSES = 25
SUCCESS_REWARD, FAILURE_REWARD = 5.0, -1.0
# The scaled observation divides by these, so that entries lie in about [-1, 1].
SPEED_SCALE = speed(MAX_DURATION)  # px/s

RewardForm = Literal["paper", "sparse"]
ObservationForm = Literal["scaled", "pixels"]

FUEL = "fuel"  # the tensordict entry: the fraction of the tank that is left

OBSERVATION_NAMES = (
    "start_x",
    "start_y",
    "goal_x",
    "goal_y",
    "centre_x",
    "centre_y",
    "radius",
    "controller",
    "boat_x",
    "boat_y",
    "velocity_x",
    "velocity_y",
    "fuel",
    "distance",
)
SCALED_NAMES = (*OBSERVATION_NAMES, "to_goal_x", "to_goal_y")


def observation_names(form: ObservationForm) -> tuple[str, ...]:
    """Return the names of the observation's entries in one of its forms."""
    return OBSERVATION_NAMES if form == "pixels" else SCALED_NAMES


# Each press has 16 random numbers of its episode's noise; Gaussian number i is made of the uniform ones 2i and 2i + 1.
NUMBERS_PER_PRESS = 16
# Indices of these: uniform ones, then Gaussian ones.
SLIP, SLIPPED_KEY = 0, 1
MOTOR, SENSOR = 1, 2


def unit_directions(degrees: Sequence[float]) -> tuple[tuple[float, float], ...]:
    """Return unit directions (x, y), rounded so that a right angle has exact ones."""
    angles = [math.radians(each) for each in degrees]
    return tuple((round(math.cos(angle), 15) + 0.0, round(math.sin(angle), 15) + 0.0) for angle in angles)


class Boats(NamedTuple):
    """Boats to choose from, in place of people's two: their names, and the degrees in which each key pushes."""

    names: tuple[str, ...]
    degrees: tuple[tuple[float, ...], ...]

    @property
    def directions(self) -> tuple[tuple[tuple[float, float], ...], ...]:
        """The unit directions (x, y) of each boat's keys."""
        return tuple(unit_directions(each) for each in self.degrees)


class Rules(NamedTuple):
    """The settings of an environment, as BoatDockEnv explains them."""

    controller: str = "choose"
    keymap: Literal[1, 2, "random"] = 1
    reward: RewardForm = "paper"
    observation: ObservationForm = "scaled"
    motor_noise: tuple[float, ...] = (0.0, 0.0)  # of each boat
    sensor_noise: float = 0.0
    slip: float = 0.0
    boats: Boats | None = None  # None: people's two
    switch_cost: float | None = None  # seconds of fuel; None: a boat is kept for the episode

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the boats, in the order of their numbers."""
        return CONTROLLERS if self.boats is None else self.boats.names

    @property
    def are_peoples(self) -> bool:
        """Whether the boats are people's two, of which one is kept for the episode."""
        return self.boats is None and self.switch_cost is None


class BoatState(NamedTuple):
    """Columns `[N]`; px from the harbour's centre, fuel in seconds, integers int32.

    The velocity is that at the end of the last press, before the glide. `episode` is -1 before the first reset.
    """

    start_x: Tensor
    start_y: Tensor
    goal_x: Tensor
    goal_y: Tensor
    x: Tensor
    y: Tensor
    velocity_x: Tensor
    velocity_y: Tensor
    fuel: Tensor
    controller: Tensor
    keymap: Tensor
    presses: Tensor
    outcome: Tensor
    episode: Tensor

    @property
    def steps(self) -> Tensor:
        """Number of presses of the episode so far."""
        return self.presses
