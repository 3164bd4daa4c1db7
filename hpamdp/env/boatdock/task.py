"""The parts of the task: lengths, times, names, and the rules and the state of boats. Nothing here needs torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

if TYPE_CHECKING:
    from torch import Tensor

HARBOUR_RADIUS = 120.0
DOCK_RADIUS = 15.0
GLIDE = 0.95  # length and duration of the glide, as multiples of those while the key is down
DOCKING_SPEED = 74.0  # px/s, the highest speed at which a boat docks
TANK = 6.0  # seconds of pressing in a full tank
MAX_DURATION = 2.0  # seconds


def speed(duration: Any) -> Any:
    """Return the speed (px/s) after pressing for `duration` seconds from rest, for a number, an array or a tensor."""
    return duration * duration * (100.0 - (20.0 / 3.0) * duration)


MAX_PRESSES = 25
SUCCESS_REWARD, FAILURE_REWARD = 5.0, -1.0


class Outcome(IntEnum):
    """How an episode ended: the number in every table and tensordict, its words in the browser, its colour in figures.

    In this order: going on, success, the failures, the time limit. Numbers, rewards, tables, figures, files and the
    page follow from it. When an outcome occurs is written where presses are: for columns in `physics.press`, for one
    row in `kernel.press`, and in `play/page/physics.js`. `planner` knows only docking at rest: if a rule forbids some
    of its plans, it would give a wrong ceiling without an error. A new constant also goes into `boat_page.shared_data`.
    tests/test_rule_copies.py compares names and constants, tests/test_planner.py plays the plans.
    """

    words: str
    colour: str

    def __new__(cls, number: int, words: str, colour: str) -> Outcome:
        """Return a member with its words and colour."""
        member = int.__new__(cls, number)
        member._value_, member.words, member.colour = number, words, colour
        return member

    SAILING = 0, "Sailing", "#8c8c8c"
    SUCCESS = 1, "Docked", "#009E73"
    TOO_FAST = 2, "Too fast", "#D55E00"
    OUT_OF_BOUNDS = 3, "Out of the harbour", "#AA4499"
    OUT_OF_FUEL = 4, "Out of fuel", "#332288"
    TIME_LIMIT = 5, f"{MAX_PRESSES} presses and no dock", "#7FC8F2"


OUTCOMES = tuple(outcome.name.lower() for outcome in Outcome)
# Plain numbers, which kernels and tensors take.
SAILING, SUCCESS, TOO_FAST, OUT_OF_BOUNDS, OUT_OF_FUEL, TIME_LIMIT = map(int, Outcome)

# With no more fuel than this (seconds) the tank counts as empty. The remainder is a rounding error of float32.
DRY = 1e-6

CENTRE = (640.0, 512.0)  # px on the screen
LAYOUT_RADIUS = 110.0
MIN_SEPARATION = 30.0
NUM_KEYS = 3

INCONGRUENT, CONGRUENT = 0, 1
CONTROLLERS = ("incongruent", "congruent")  # option 0, option 1
NOT_CHOSEN = -1

# Controllers that `boats` may name, with the direction of each key in degrees (0 to the right, 90 down). People's
# incongruent boat had one of two key maps. Here these are two controllers.
CONTROLLER_DEGREES: dict[str, tuple[float, ...]] = {
    "congruent": (150.0, 270.0, 30.0),
    "incongruent1": (330.0, 210.0, 90.0),
    "incongruent2": (90.0, 330.0, 210.0),
}

# Indices of an episode's random numbers. The first are for the layout, three for each try.
LAYOUT_TRIES = 4
INDEX_ANGLE = 3 * LAYOUT_TRIES
INDEX_CONTROLLER = 3 * LAYOUT_TRIES + 1
INDEX_KEYMAP = 3 * LAYOUT_TRIES + 2

# The scaled observation divides by these, so that entries lie in about [-1, 1].
SPEED_SCALE = speed(MAX_DURATION)  # px/s

RewardForm = Literal["paper", "sparse"]
ObservationForm = Literal["scaled", "pixels"]

FUEL = "fuel"  # the tensordict entry with the remaining fraction of the tank

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
    """Return the names of the entries of one form of the observation."""
    return OBSERVATION_NAMES if form == "pixels" else SCALED_NAMES


# Each press has 16 random numbers for noise. Gaussian number i uses the uniform numbers 2i and 2i + 1.
NUMBERS_PER_PRESS = 16
# Indices of these numbers. SLIP and SLIPPED_KEY count uniform numbers, MOTOR and SENSOR Gaussian ones. SENSOR is the
# first of six.
SLIP, SLIPPED_KEY = 0, 1
MOTOR, SENSOR = 1, 2


def unit_directions(degrees: Sequence[float]) -> tuple[tuple[float, float], ...]:
    """Return unit directions (x, y), rounded so that multiples of 90 degrees are exact."""
    angles = [math.radians(each) for each in degrees]
    return tuple((round(math.cos(angle), 15) + 0.0, round(math.sin(angle), 15) + 0.0) for angle in angles)


class Boats(NamedTuple):
    """Boats that replace people's two: their names, and the direction of each key in degrees."""

    names: tuple[str, ...]
    degrees: tuple[tuple[float, ...], ...]

    @property
    def directions(self) -> tuple[tuple[tuple[float, float], ...], ...]:
        """The unit directions (x, y) of each boat's keys."""
        return tuple(unit_directions(each) for each in self.degrees)


class BoatState(NamedTuple):
    """The state of N boats, columns `[N]`: positions in px from the harbour's centre, fuel in seconds, int32 integers.

    The velocity is the one at the end of the last press, before the glide. `episode` is -1 before the first reset.
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
