"""People's boats against our physics: do single presses end as recorded, do first presses reach as far?"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.data.human.released_file import HumanData
from hpamdp.env.boatdock import harbour, physics

AIMED_WITHIN = 14.0  # px by which a course may pass the goal's centre and still count as aimed at the dock
MIN_PRESSED = 5.0  # px that a first press covers while the key is down, to be measured at all
_BAND = (0.97, 1.03)  # of the shortest (next key pressed at once) and the longest (at rest) way of a press


class Singles(NamedTuple):
    """Single, completely logged presses on a course that passes near the goal, fields `[M]`; px, s."""

    pressed: Tensor  # px covered while the key is down
    to_dock: Tensor  # px to the dock's circle
    outcome: Tensor
    predicted: Tensor  # outcome in our physics


class FirstPresses(NamedTuple):
    """First presses of completely logged longer episodes, fields `[M]`; px."""

    pressed: Tensor
    travelled: Tensor  # until the next press began
    is_inside: Tensor  # of the band that our physics allows


class Fit(NamedTuple):
    """What people's single presses say of the glide and the docking speed (px/s), with 95 % intervals (bootstrap).

    `likely` are the constants of the largest likelihood, `agreeing` those that predict most outcomes right; each is
    `(value, low, high)`. `agreement` `[glide, speed]` is the share predicted right on the grid of `glides`, `speeds`.
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
    of = data.episodes[data.presses["episode"]]
    single = of["complete"] & (of["presses"] == 1)
    of, presses = of[single], data.presses[single]
    heading = harbour.direction(of["controller"], of["keymap"], presses["key"])
    here, goal = (points - of["centre"] for points in (presses["position"], of["goal"]))
    ahead = ((goal - here) * torch.stack(heading, 1)).sum(1)
    aside = (goal - here)[:, 0] * heading[1] - (goal - here)[:, 1] * heading[0]
    aimed = (aside.abs() < AIMED_WITHIN) & (ahead > 0.0)
    course = [column[aimed] for column in (*here.unbind(1), *goal.unbind(1), *heading)]
    duration = presses["duration"][aimed]
    sailed = physics.press(*course[:2], torch.full_like(duration, physics.TANK), *course[2:], duration)
    to_dock = physics.distance_to_dock(*course)
    return Singles(physics.pressed_distance(duration), to_dock, of["outcome"][aimed], sailed.outcome.long())


def agreement(singles: Singles) -> float:
    """Return the share of single presses that end as recorded: docked, too fast, or the dock not reached."""
    return (_reached(singles.outcome) == _reached(singles.predicted)).double().mean().item()


def _reached(outcome: Tensor) -> Tensor:
    is_dock = (outcome == physics.SUCCESS) | (outcome == physics.TOO_FAST)
    return torch.where(is_dock, outcome, physics.SAILING)


def first_presses(data: HumanData) -> FirstPresses:
    """Measure how far first presses went until the next press began."""
    of = data.episodes[data.presses["episode"]]
    pressed = physics.pressed_distance(data.presses["duration"])
    is_first = (data.presses["press"] == 0) & ~data.presses["is_final"] & of["complete"] & (pressed > MIN_PRESSED)
    presses, pressed = data.presses[is_first], pressed[is_first]
    travelled = (presses["next_position"] - presses["position"]).norm(dim=1)
    low, high = _BAND[0] * pressed, _BAND[1] * (1.0 + physics.GLIDE) * pressed
    return FirstPresses(pressed, travelled, (travelled >= low) & (travelled <= high))


def fit(singles: Singles, num_bootstraps: int = 400, seed: int = 0) -> Fit:
    """Return which glide and docking speed people's single presses speak for, on a grid, from episodes drawn anew.

    The likelihood gives the speed at the dock and the way made there a Gaussian error each, whose sizes are fitted too.
    """
    glides = torch.arange(0.7, 1.305, 0.02, dtype=torch.float64)
    speeds = torch.arange(60.0, 100.5, 1.0, dtype=torch.float64)
    speed_errors = torch.tensor([2.0, 4.0, 8.0, 16.0], dtype=torch.float64)
    way_errors = torch.tensor([0.5, 2.0, 8.0], dtype=torch.float64)
    num = len(singles.pressed)
    draws = torch.randint(num, (num_bootstraps, num), generator=torch.Generator().manual_seed(seed))
    weights = torch.zeros(num_bootstraps, num, dtype=torch.float64)
    weights.scatter_add_(1, draws, torch.ones(draws.shape, dtype=torch.float64))
    weights = torch.cat([torch.ones(1, num, dtype=torch.float64), weights])  # the episodes as they are come first

    axes = (axis.flatten()[:, None] for axis in torch.meshgrid(glides, speeds, speed_errors, way_errors, indexing="ij"))
    glide, limit, speed_error, way_error = axes
    likely = (_log_likelihood(singles, glide, limit, speed_error, way_error) @ weights.T).argmax(0)
    likely_glide, likely_speed = _interval(glide[likely, 0]), _interval(limit[likely, 0])

    glide, limit = (axis.flatten()[:, None] for axis in torch.meshgrid(glides, speeds, indexing="ij"))
    spare, speed = _arrival(singles, glide)
    docked = torch.where(speed > limit, physics.TOO_FAST, physics.SUCCESS)
    is_right = (torch.where(spare < 0.0, physics.SAILING, docked) == _reached(singles.outcome)).double()
    agreeing = (is_right @ weights.T).argmax(0)
    return Fit(
        likely_glide,
        likely_speed,
        _interval(glide[agreeing, 0]),
        _interval(limit[agreeing, 0]),
        glides,
        speeds,
        is_right.mean(1).reshape(len(glides), len(speeds)),
    )


def _arrival(singles: Singles, glide: Tensor) -> tuple[Tensor, Tensor]:
    """Return how far beyond the dock's circle a press would go (px) and the speed there (px/s), `[grid, M]`."""
    pressed, to_dock = singles.pressed.double(), singles.to_dock.double()
    spare = (1.0 + glide) * pressed - to_dock
    # While the key is down the speed follows from the way made, in the glide from the way left.
    virtual = physics.duration_for(torch.where(to_dock > pressed, (spare / glide).clamp(min=0.0), to_dock))
    return spare, physics.speed(virtual)


def _log_likelihood(singles: Singles, glide: Tensor, limit: Tensor, speed_error: Tensor, way_error: Tensor) -> Tensor:
    spare, speed = _arrival(singles, glide)
    reaches, is_over = spare / way_error, (speed - limit) / speed_error
    log = torch.special.log_ndtr
    docks = log(reaches) + torch.where(singles.outcome == physics.TOO_FAST, log(is_over), log(-is_over))
    return torch.where(_reached(singles.outcome) == physics.SAILING, log(-reaches), docks)


def _interval(values: Tensor) -> tuple[float, float, float]:
    low, high = values[1:].quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return values[0].item(), low, high
