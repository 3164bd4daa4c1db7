"""What the task is made of: lengths, times, names, the settings and the state of boats; nothing here needs torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

from hpamdp.messages import invalid_action

if TYPE_CHECKING:
    from torch import Tensor

HARBOUR_RADIUS = 120.0
DOCK_RADIUS = 15.0
GLIDE = 0.95  # length and duration of the glide, as multiples of those of the pressed stretch
DOCKING_SPEED = 74.0  # px/s, the highest speed of arrival that docks
TANK = 6.0  # seconds of pressing in a full tank
MAX_DURATION = 2.0  # seconds

SAILING, SUCCESS, TOO_FAST, OUT_OF_BOUNDS, OUT_OF_FUEL, TIME_LIMIT = range(6)
OUTCOMES = ("sailing", "success", "too_fast", "out_of_bounds", "out_of_fuel", "time_limit")

# With less fuel than this (seconds) the tank counts as empty: the rest is rounding in float32.
DRY = 1e-6

CENTRE = (640.0, 512.0)  # px on the screen
LAYOUT_RADIUS = 110.0
MIN_SEPARATION = 30.0
NUM_KEYS = 3

INCONGRUENT, CONGRUENT = 0, 1
CONTROLLERS = ("incongruent", "congruent")  # option 0, option 1
NOT_CHOSEN = -1

# Indices of an episode's random numbers: three for each try at a layout, then the others.
LAYOUT_TRIES = 4
INDEX_ANGLE = 3 * LAYOUT_TRIES
INDEX_CONTROLLER = 3 * LAYOUT_TRIES + 1
INDEX_KEYMAP = 3 * LAYOUT_TRIES + 2

MAX_PRESSES = 25
SUCCESS_REWARD, FAILURE_REWARD = 5.0, -1.0
# The scaled observation divides by these, so that entries lie in about [-1, 1].
SPEED_SCALE = MAX_DURATION**2 * (100.0 - 20.0 / 3.0 * MAX_DURATION)  # px/s, at the end of the longest press

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

# Each press has 16 random numbers of its episode's noise; Gaussian number i is made of the uniform ones 2i and 2i + 1.
NUMBERS_PER_PRESS = 16
# Indices of these: uniform ones, then Gaussian ones.
SLIP, SLIPPED_KEY = 0, 1
MOTOR, SENSOR = 1, 2


class Rules(NamedTuple):
    """The settings of an environment, as BoatDockEnv explains them."""

    controller: Literal["choose", "congruent", "incongruent", "random"] = "choose"
    keymap: Literal[1, 2, "random"] = 1
    reward: RewardForm = "paper"
    observation: ObservationForm = "scaled"
    motor_noise: tuple[float, float] = (0.0, 0.0)  # of the incongruent and of the congruent boat
    sensor_noise: float = 0.0
    slip: float = 0.0
    is_evaluation: bool = False  # whether episodes and noise come from the streams of evaluation


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


def one_or_two(motor_noise: float | Sequence[float]) -> tuple[float, float]:
    """Return the motor noise of the incongruent and of the congruent boat."""
    noises = (motor_noise, motor_noise) if isinstance(motor_noise, int | float) else tuple(motor_noise)
    if len(noises) != 2:
        raise ValueError(f"BoatDockEnv: motor_noise={list(noises)}, but must be one number or two")
    return noises


def check_arguments(num_envs: int, rules: Rules) -> None:
    """Check what a user sets.

    Raises:
        ValueError: a value is not allowed.
    """
    choices = {
        "controller": ("choose", *CONTROLLERS[::-1], "random"),
        "keymap": (1, 2, "random"),
        "reward": ("paper", "sparse"),
        "observation": ("scaled", "pixels"),
    }
    for name, allowed in choices.items():
        value = getattr(rules, name)
        if value not in allowed:
            raise ValueError(f"BoatDockEnv: {name}={value!r}, but must be one of {', '.join(map(str, allowed))}")
    if num_envs < 1:
        raise ValueError(f"BoatDockEnv: num_envs={num_envs}, but must be at least 1")
    if not 0.0 <= rules.slip <= 1.0:
        raise ValueError(f"BoatDockEnv: slip={rules.slip}, but must be a probability")
    noises = (("motor_noise", rules.motor_noise, 10), ("sensor_noise", (rules.sensor_noise,), 1000))
    for name, values, largest in noises:
        for value in values:
            if not 0.0 <= value <= largest:
                raise ValueError(f"BoatDockEnv: {name}={value}, but must lie between 0 and {largest}")


def invalid_press(row: int, option: object, key: object, durations: object) -> ValueError:
    """Return the error for an invalid action of boat `row`."""
    return invalid_action(
        row,
        {
            "option": (option, "allowed 0 to 1"),
            "key": (key, "allowed 0 to 2"),
            "durations": (durations, "the pressed key's must be finite"),
        },
    )
