"""Compare our physics with the recording: the outcomes of single presses, and the distances of first presses."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.data.human.released_file import HumanData
from hpamdp.env.boatdock import harbour, physics

AIMED_WITHIN = 14.0  # px; a course that passes the goal's centre closer than this is aimed at the dock
MIN_PRESSED = 5.0  # px; first presses that cover less while the key is down are not measured
# The distance that a press may travel: from 0.97 of the shortest (the next key is pressed at once) to 1.03 of the
# longest (the boat comes to rest).
_SHORTEST_MARGIN = 0.97
_LONGEST_MARGIN = 1.03


class Singles(NamedTuple):
    """Single presses of completely logged episodes that were aimed at the dock, each field `[M]`."""

    pressed: Tensor  # px covered while the key is down
    to_dock: Tensor  # px to the dock's circle
    outcome: Tensor  # as recorded
    predicted: Tensor  # in our physics


class FirstPresses(NamedTuple):
    """First presses of completely logged episodes with more than one press, each field `[M]`."""

    pressed: Tensor  # px covered while the key is down
    travelled: Tensor  # px covered until the next press began
    is_inside: Tensor  # whether our physics allows the distance travelled


class Fit(NamedTuple):
    """The glide and the docking speed (px/s) fitted to people's single presses, with 95 % bootstrap intervals.

    Attributes:
        likely_glide, likely_speed: the constants of largest likelihood, as (value, low, high).
        agreeing_glide, agreeing_speed: the constants that predict the most outcomes correctly, as (value, low, high).
        glides, speeds: the grid, `[G]` and `[S]`.
        agreement: fraction of outcomes predicted correctly on the grid, `[G, S]`.
    """

    likely_glide: tuple[float, float, float]
    likely_speed: tuple[float, float, float]
    agreeing_glide: tuple[float, float, float]
    agreeing_speed: tuple[float, float, float]
    glides: Tensor
    speeds: Tensor
    agreement: Tensor


def single_presses(data: HumanData) -> Singles:
    """Replay people's single, completely logged presses that were aimed at the dock."""
    episodes = data.episodes[data.presses["episode"]]  # the episode of each press
    is_single = episodes["complete"] & (episodes["presses"] == 1)
    episodes = episodes[is_single]
    presses = data.presses[is_single]
    dir_x, dir_y = harbour.direction(episodes["controller"], episodes["keymap"], presses["key"])
    position = presses["position"] - episodes["centre"]
    goal = episodes["goal"] - episodes["centre"]
    to_goal = goal - position
    ahead = (to_goal * torch.stack([dir_x, dir_y], 1)).sum(1)
    aside = to_goal[:, 0] * dir_y - to_goal[:, 1] * dir_x
    is_aimed = (aside.abs() < AIMED_WITHIN) & (ahead > 0.0)

    x, y = position[is_aimed].unbind(1)
    goal_x, goal_y = goal[is_aimed].unbind(1)
    dir_x = dir_x[is_aimed]
    dir_y = dir_y[is_aimed]
    duration = presses["duration"][is_aimed]
    tank = torch.full_like(duration, physics.TANK)
    sailed = physics.press(x, y, tank, goal_x, goal_y, dir_x, dir_y, duration)
    return Singles(
        pressed=physics.pressed_distance(duration),
        to_dock=physics.distance_to_dock(x, y, goal_x, goal_y, dir_x, dir_y),
        outcome=episodes["outcome"][is_aimed],
        predicted=sailed.outcome.long(),
    )


def agreement(singles: Singles) -> float:
    """Return the fraction of single presses with the recorded outcome: docked, too fast, or dock not reached."""
    return (_reached(singles.outcome) == _reached(singles.predicted)).double().mean().item()


def _reached(outcome: Tensor) -> Tensor:
    """Return the outcomes, with SAILING for every outcome that is not at the dock."""
    reached_dock = (outcome == physics.SUCCESS) | (outcome == physics.TOO_FAST)
    return torch.where(reached_dock, outcome, physics.SAILING)


def first_presses(data: HumanData) -> FirstPresses:
    """Measure how far first presses went until the next press began."""
    episodes = data.episodes[data.presses["episode"]]  # the episode of each press
    pressed = physics.pressed_distance(data.presses["duration"])
    is_first = (data.presses["press"] == 0) & ~data.presses["is_final"]
    is_measured = is_first & episodes["complete"] & (pressed > MIN_PRESSED)
    presses = data.presses[is_measured]
    pressed = pressed[is_measured]
    travelled = (presses["next_position"] - presses["position"]).norm(dim=1)
    shortest = _SHORTEST_MARGIN * pressed
    longest = _LONGEST_MARGIN * (1.0 + physics.GLIDE) * pressed
    return FirstPresses(pressed, travelled, is_inside=(travelled >= shortest) & (travelled <= longest))


def fit(singles: Singles, num_bootstraps: int = 400, seed: int = 0) -> Fit:
    """Fit the glide and the docking speed to people's single presses, on a grid, and bootstrap over presses.

    The likelihood has two Gaussian errors: of the speed at the dock, and of the distance covered. Their standard
    deviations are fitted, too.
    """
    glides = torch.arange(0.7, 1.305, 0.02, dtype=torch.float64)
    speeds = torch.arange(60.0, 100.5, 1.0, dtype=torch.float64)
    speed_errors = torch.tensor([2.0, 4.0, 8.0, 16.0], dtype=torch.float64)
    distance_errors = torch.tensor([0.5, 2.0, 8.0], dtype=torch.float64)
    weights = _bootstrap_weights(len(singles.pressed), num_bootstraps, seed)

    glide, limit, speed_error, distance_error = _grid(glides, speeds, speed_errors, distance_errors)
    log_likelihood = _log_likelihood(singles, glide, limit, speed_error, distance_error)
    likely = (log_likelihood @ weights.T).argmax(0)
    likely_glide = _interval(glide[likely, 0])
    likely_speed = _interval(limit[likely, 0])

    glide, limit = _grid(glides, speeds)
    spare, speed = _arrival(singles, glide)
    at_dock = torch.where(speed > limit, physics.TOO_FAST, physics.SUCCESS)
    predicted = torch.where(spare < 0.0, physics.SAILING, at_dock)
    is_right = (predicted == _reached(singles.outcome)).double()
    agreeing = (is_right @ weights.T).argmax(0)
    return Fit(
        likely_glide=likely_glide,
        likely_speed=likely_speed,
        agreeing_glide=_interval(glide[agreeing, 0]),
        agreeing_speed=_interval(limit[agreeing, 0]),
        glides=glides,
        speeds=speeds,
        agreement=is_right.mean(1).reshape(len(glides), len(speeds)),
    )


def _bootstrap_weights(num: int, num_bootstraps: int, seed: int) -> Tensor:
    """Return the weight of each press `[1 + num_bootstraps, num]`: 1 in the first row, then resampled counts."""
    sampled = torch.randint(num, (num_bootstraps, num), generator=torch.Generator().manual_seed(seed))
    resampled = torch.zeros(num_bootstraps, num, dtype=torch.float64)
    resampled.scatter_add_(1, sampled, torch.ones(sampled.shape, dtype=torch.float64))
    return torch.cat([torch.ones(1, num, dtype=torch.float64), resampled])


def _grid(*axes: Tensor) -> list[Tensor]:
    """Return each axis's values at all points of the grid of the axes, `[points, 1]`."""
    return [values.flatten().unsqueeze(1) for values in torch.meshgrid(*axes, indexing="ij")]


def _arrival(singles: Singles, glide: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distance that each press would go beyond the dock's circle (px), and the speed there (px/s).

    Both are `[points, M]`.
    """
    pressed = singles.pressed.double()
    to_dock = singles.to_dock.double()
    spare = (1.0 + glide) * pressed - to_dock
    # The speed follows from the distance covered while the key is down, and from the distance left in the glide.
    in_glide = to_dock > pressed
    distance = torch.where(in_glide, (spare / glide).clamp(min=0.0), to_dock)
    return spare, physics.speed(physics.duration_for(distance))


def _log_likelihood(
    singles: Singles, glide: Tensor, limit: Tensor, speed_error: Tensor, distance_error: Tensor
) -> Tensor:
    """Return the log-likelihood of each press's outcome at each point of the grid, `[points, M]`."""
    spare, speed = _arrival(singles, glide)
    log_reaches = torch.special.log_ndtr(spare / distance_error)
    log_falls_short = torch.special.log_ndtr(-spare / distance_error)
    log_too_fast = torch.special.log_ndtr((speed - limit) / speed_error)
    log_docks = torch.special.log_ndtr(-(speed - limit) / speed_error)
    at_dock = log_reaches + torch.where(singles.outcome == physics.TOO_FAST, log_too_fast, log_docks)
    return torch.where(_reached(singles.outcome) == physics.SAILING, log_falls_short, at_dock)


def _interval(values: Tensor) -> tuple[float, float, float]:
    """Return the first value and the 95 % interval of the others, as (value, low, high)."""
    low, high = values[1:].quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return values[0].item(), low, high
