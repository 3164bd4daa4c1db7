"""What the task is made of: lengths, times, names, the settings and the state of boats; nothing here needs torch."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
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

# Controllers that `boats` may name: the degrees in which each key pushes, 0 to the right, 90 down. People's incongruent
# boat had one of two key maps, which are two controllers here.
CONTROLLER_DEGREES: dict[str, tuple[float, ...]] = {
    "congruent": (150.0, 270.0, 30.0),
    "incongruent1": (330.0, 210.0, 90.0),
    "incongruent2": (90.0, 330.0, 210.0),
}
_RESERVED = ("choose", "random")  # other values of `controller`

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


class Boats(NamedTuple):
    """Boats to choose from, in place of people's two: their names, and the degrees in which each key pushes."""

    names: tuple[str, ...]
    degrees: tuple[tuple[float, ...], ...]

    @property
    def directions(self) -> tuple[tuple[tuple[float, float], ...], ...]:
        """The unit directions (x, y) of each boat's keys; rounded, so that a right angle has exact ones."""
        return tuple(
            tuple((round(math.cos(math.radians(d)), 12), round(math.sin(math.radians(d)), 12)) for d in keys)
            for keys in self.degrees
        )


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
    is_evaluation: bool = False  # whether episodes and noise come from the streams of evaluation

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


def chosen_boats(names: Sequence[str] | None, controllers: Mapping[str, Sequence[float]] | None = None) -> Boats | None:
    """Return the boats with these names; arguments `boats` and `controllers` as in BoatDockEnv.

    Raises:
        ValueError: a boat has no controller, or a controller has no directions for the keys.
    """
    known: dict[str, tuple[float, ...]] = dict(CONTROLLER_DEGREES)
    for name, degrees in (controllers or {}).items():
        given = f"BoatDockEnv: controllers.{name}={list(degrees)}"
        if name in _RESERVED:
            raise ValueError(f"{given}, but {name} is no name for a controller; take another one")
        if len(degrees) != NUM_KEYS or not all(math.isfinite(d) for d in degrees):
            raise ValueError(f"{given}, but must be {NUM_KEYS} directions in degrees, one for each key")
        degrees = tuple(float(d) for d in degrees)
        if degrees != known.setdefault(name, degrees):
            raise ValueError(f"{given}, but {name} has {list(known[name])}; take another name")
    if names is None:
        return None
    given = f"BoatDockEnv: boats={list(names)}"
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"{given}, but there is no controller {unknown[0]}; controllers has {', '.join(known)}")
    if not names or len(set(names)) < len(names):
        raise ValueError(f"{given}, but must be one or more different controllers")
    return Boats(tuple(names), tuple(known[name] for name in names))


def noise_of_each(motor_noise: float | Sequence[float], boats: Boats | None) -> tuple[float, ...]:
    """Return the motor noise of each boat.

    Raises:
        ValueError: there are not as many as boats.
    """
    num = len(CONTROLLERS if boats is None else boats.names)
    noises = (motor_noise,) * num if isinstance(motor_noise, int | float) else tuple(motor_noise)
    if len(noises) != num:
        allowed = "one number or two" if num == 2 else f"one number or {num}, one for each boat"
        raise ValueError(f"BoatDockEnv: motor_noise={list(noises)}, but must be {allowed}")
    return noises


def make_rules(
    *,
    controller: str,
    keymap: Literal[1, 2, "random"],
    reward: RewardForm,
    observation: ObservationForm,
    motor_noise: float | Sequence[float],
    sensor_noise: float,
    slip: float,
    boats: Sequence[str] | None,
    controllers: Mapping[str, Sequence[float]] | None,
    switch_cost: float | None,
) -> Rules:
    """Return the settings that a user gives, as BoatDockEnv explains them.

    Raises:
        ValueError: as `chosen_boats` and `noise_of_each`.
    """
    chosen = chosen_boats(boats, controllers)
    noise = noise_of_each(motor_noise, chosen)
    return Rules(controller, keymap, reward, observation, noise, sensor_noise, slip, chosen, switch_cost)


def check_arguments(num_envs: int, rules: Rules) -> None:
    """Check what a user sets.

    Raises:
        ValueError: a value is not allowed.
    """
    choices = {
        "controller": ("choose", *(CONTROLLERS[::-1] if rules.boats is None else rules.names), "random"),
        "keymap": (1, 2, "random"),
        "reward": ("paper", "sparse"),
        "observation": ("scaled", "pixels"),
    }
    for name, allowed in choices.items():
        value = getattr(rules, name)
        if value not in allowed:
            raise ValueError(f"BoatDockEnv: {name}={value!r}, but must be one of {', '.join(map(str, allowed))}")
    _check_boats(rules)
    if num_envs < 1:
        raise ValueError(f"BoatDockEnv: num_envs={num_envs}, but must be at least 1")
    if not 0.0 <= rules.slip <= 1.0:
        raise ValueError(f"BoatDockEnv: slip={rules.slip}, but must be a probability")
    noises = (("motor_noise", rules.motor_noise, 10), ("sensor_noise", (rules.sensor_noise,), 1000))
    for name, values, largest in noises:
        for value in values:
            if not 0.0 <= value <= largest:
                raise ValueError(f"BoatDockEnv: {name}={value}, but must lie between 0 and {largest}")


def _check_boats(rules: Rules) -> None:
    """Check the settings of other boats and of changes between boats."""
    names, cost = list(rules.names), rules.switch_cost
    if rules.boats is not None and rules.keymap != 1:
        raise ValueError(
            f"BoatDockEnv: keymap={rules.keymap!r}: the controllers in boats={names} have none; leave it out"
        )
    if rules.controller == "choose" and len(names) < 2:
        raise ValueError(f"BoatDockEnv: boats={names}: nothing to choose; name more, or use controller={names[0]}")
    if cost is None:
        return
    if not 0.0 <= cost <= TANK:
        raise ValueError(f"BoatDockEnv: switch_cost={cost}, but must lie between 0 and {TANK:g} seconds of fuel")
    if rules.controller != "choose":
        raise ValueError(
            f"BoatDockEnv: switch_cost={cost}: controller={rules.controller} never changes boats; "
            "use controller=choose or leave switch_cost out"
        )


def invalid_press(row: int, option: object, key: object, durations: object, num_options: int) -> ValueError:
    """Return the error for an invalid action of boat `row`."""
    return invalid_action(
        row,
        {
            "option": (option, f"allowed 0 to {num_options - 1}"),
            "key": (key, "allowed 0 to 2"),
            "durations": (durations, "the pressed key's must be finite"),
        },
    )
