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
    return (reached(singles.outcome) == reached(singles.predicted)).double().mean().item()


def reached(outcome: Tensor) -> Tensor:
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
