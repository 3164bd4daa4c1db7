"""The harbour: its position on the screen, the directions of keys, the layouts and the score."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.boatdock.task import (
    CENTRE,
    CONGRUENT,
    CONTROLLER_DEGREES,
    CONTROLLERS,
    FAILURE_REWARD,
    INCONGRUENT,
    INDEX_ANGLE,
    INDEX_CONTROLLER,
    INDEX_KEYMAP,
    LAYOUT_RADIUS,
    LAYOUT_TRIES,
    MIN_SEPARATION,
    NOT_CHOSEN,
    NUM_KEYS,
    SUCCESS,
    SUCCESS_REWARD,
    TANK,
    unit_directions,
)

_COS30 = math.sqrt(3.0) / 2.0
# Directions by row and key. Rows: incongruent with key map 1, incongruent with key map 2, congruent.
DIRECTIONS = tuple(unit_directions(CONTROLLER_DEGREES[name]) for name in ("incongruent1", "incongruent2", "congruent"))


def direction(controller: Tensor, keymap: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """Return the unit direction (x, y) of a key, each `[*B]` float32.

    Args:
        controller: INCONGRUENT or CONGRUENT, `[*B]`.
        keymap: 1 or 2, `[*B]`. Only the incongruent controller depends on it.
        key: 0, 1 or 2, `[*B]`.
    """
    # Use arithmetic instead of the table, because a gather keeps the compiled step from being vectorised. The
    # incongruent boat's directions are opposite to the congruent ones, in another order of keys.
    reordered = torch.where(keymap == 1, torch.where(key == 0, 0, 3 - key), torch.where(key == 2, 2, 1 - key))
    congruent = controller == CONGRUENT
    column = torch.where(congruent, key, reordered)
    sign = torch.where(congruent, 1.0, -1.0).float()
    return sign * _COS30 * (column - 1).to(torch.float32), sign * torch.where(column == 1, -1.0, 0.5).float()


class Layout(NamedTuple):
    """Start and goal of an episode, px from the harbour's centre, every field `[*B]`."""

    start_x: Tensor
    start_y: Tensor
    goal_x: Tensor
    goal_y: Tensor


def sample_layout(rng: counter_rng.RngKey) -> Layout:
    """Sample start and goal uniformly in the disc, at least MIN_SEPARATION apart.

    Points that are too close are sampled again. A try samples the two squared radii and the angle between the points,
    because the distance depends on nothing else. The angle of the pair as a whole is sampled last. After four tries, 2
    in 100,000 layouts are still too close. Their goal is put on the far side of the centre, which avoids a loop that
    depends on the data.

    Args:
        rng: random-number keys `[*B]` from `counter_rng.rng_key`.
    """

    def attempt(first_index: int) -> tuple[Tensor, Tensor, Tensor]:
        return (
            counter_rng.uniform(rng, first_index),
            counter_rng.uniform(rng, first_index + 1),
            2.0 * math.pi * counter_rng.uniform(rng, first_index + 2),
        )

    def is_near(start: Tensor, goal: Tensor, turn: Tensor) -> Tensor:
        squared = start + goal - 2.0 * (start * goal).sqrt() * turn.cos()
        return squared < (MIN_SEPARATION / LAYOUT_RADIUS) ** 2

    # Go from the last try to the first. Each try replaces the later ones unless it is too near, so the first good try
    # remains.
    tries = [attempt(3 * i) for i in range(LAYOUT_TRIES)]
    near = [is_near(*each) for each in tries]
    start, goal, turn = tries[-1]
    goal = torch.where(near[-1], 0.25, goal)
    turn = torch.where(near[-1], math.pi, turn)
    for each, is_too_near in zip(tries[-2::-1], near[-2::-1], strict=True):
        start = torch.where(is_too_near, start, each[0])
        goal = torch.where(is_too_near, goal, each[1])
        turn = torch.where(is_too_near, turn, each[2])

    angle = 2.0 * math.pi * counter_rng.uniform(rng, INDEX_ANGLE)
    start_radius = LAYOUT_RADIUS * start.sqrt()
    goal_radius = LAYOUT_RADIUS * goal.sqrt()
    goal_angle = angle + turn
    return Layout(
        start_radius * angle.cos(),
        start_radius * angle.sin(),
        goal_radius * goal_angle.cos(),
        goal_radius * goal_angle.sin(),
    )


def separation(layout: Layout) -> Tensor:
    """Return the distance (px) between start and goal, `[*B]`."""
    return ((layout.goal_x - layout.start_x).square() + (layout.goal_y - layout.start_y).square()).sqrt()


def fixed_layouts(num: int, seed: int, first: int = 0) -> Layout:
    """Return `num` layouts for evaluation, from number `first` on.

    They have their own random stream, so training never uses them.
    """
    rows = torch.arange(first, first + num, dtype=torch.int32)
    episode = torch.zeros(num, dtype=torch.int32)
    return sample_layout(counter_rng.rng_key(counter_rng.seed_tensor(seed), counter_rng.EVALUATION, rows, episode))


def bearing_offset(layout: Layout) -> Tensor:
    """Return the degrees (0 to 60) between the goal's bearing and the nearest congruent direction, `[*B]`."""
    bearing = torch.rad2deg(torch.atan2(layout.goal_y - layout.start_y, layout.goal_x - layout.start_x))
    # The congruent directions lie at 30, 150 and 270 degrees (y down), 120 apart.
    return ((bearing - 30.0 + 60.0) % 120.0 - 60.0).abs()


def score(outcome: Tensor, fuel: Tensor) -> Tensor:
    """Return the score of finished episodes `[*B]`: 5 x the fuel left (fraction of a tank) on success, else -1."""
    return score_of(outcome == SUCCESS, fuel)


def score_of(is_success: Tensor, fuel: Tensor) -> Tensor:
    """Return the score `[*B]` of episodes that succeeded or failed with this fraction of fuel left."""
    return torch.where(is_success, SUCCESS_REWARD * fuel, FAILURE_REWARD)


def fuel_fraction(seconds: Tensor) -> Tensor:
    """Return seconds of fuel as a fraction of a full tank."""
    return seconds / TANK
