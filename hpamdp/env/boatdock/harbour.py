"""The harbour: its place on the screen, the two controllers with their key maps, and where boats start and dock."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.boatdock.physics import SUCCESS, TANK

CENTRE = (640.0, 512.0)  # px on the screen
LAYOUT_RADIUS = 110.0
MIN_SEPARATION = 30.0
NUM_KEYS = 3

INCONGRUENT, CONGRUENT = 0, 1
CONTROLLERS = ("incongruent", "congruent")  # option 0, option 1
NOT_CHOSEN = -1

_COS30 = math.sqrt(3.0) / 2.0
_CONGRUENT_KEYS = ((-_COS30, 0.5), (0.0, -1.0), (_COS30, 0.5))
# Key directions by [controller and key map][key]: incongruent with key map 1, with key map 2, congruent.
DIRECTIONS = (
    ((_COS30, -0.5), (-_COS30, -0.5), (0.0, 1.0)),
    ((0.0, 1.0), (_COS30, -0.5), (-_COS30, -0.5)),
    _CONGRUENT_KEYS,
)


def direction(controller: Tensor, keymap: Tensor, key: Tensor) -> tuple[Tensor, Tensor]:
    """Return the unit direction (x, y) of a key, each `[*B]` float32.

    Args:
        controller: INCONGRUENT or CONGRUENT, `[*B]`.
        keymap: 1 or 2, `[*B]`; it concerns the incongruent controller only.
        key: 0, 1 or 2, `[*B]`.
    """
    # Arithmetic instead of a table: a gather keeps the compiled step from being vectorised. The incongruent boat's
    # directions are the congruent ones reversed, in another order of keys.
    reordered = torch.where(keymap == 1, torch.where(key == 0, 0, 3 - key), torch.where(key == 2, 2, 1 - key))
    congruent = controller == CONGRUENT
    column = torch.where(congruent, key, reordered)
    sign = torch.where(congruent, 1.0, -1.0)
    return sign * _COS30 * (column - 1).to(torch.float32), sign * torch.where(column == 1, -1.0, 0.5)


class Layout(NamedTuple):
    """Where an episode starts and docks, px from the harbour's centre, every field `[*B]`."""

    start_x: Tensor
    start_y: Tensor
    goal_x: Tensor
    goal_y: Tensor


# Draws of an episode's key by purpose: three for each try at a layout, then the rest.
_TRIES = 4
_DRAW_ANGLE, DRAW_CONTROLLER, DRAW_KEYMAP = 3 * _TRIES, 3 * _TRIES + 1, 3 * _TRIES + 2


def draw_layout(key: Tensor) -> Layout:
    """Draw start and goal uniformly in the disc, both again while they are under MIN_SEPARATION apart.

    Args:
        key: int32 `[*B]` from `counter_rng.key_for`.

    A try is two squared radii and the angle between the points, which is all that the distance depends on; the angle of
    the pair comes last. Four tries leave 2 in 100,000 layouts too close; those get their goal on the far side of the
    centre, which keeps the function free of loops that depend on the data.
    """

    def attempt(first_draw: int) -> tuple[Tensor, Tensor, Tensor]:
        return (
            counter_rng.uniform(key, first_draw),
            counter_rng.uniform(key, first_draw + 1),
            2.0 * math.pi * counter_rng.uniform(key, first_draw + 2),
        )

    def is_near(start: Tensor, goal: Tensor, turn: Tensor) -> Tensor:
        squared = start + goal - 2.0 * (start * goal).sqrt() * turn.cos()
        return squared < (MIN_SEPARATION / LAYOUT_RADIUS) ** 2

    # Each try is judged on its own, and the first good one is taken.
    tries = [attempt(3 * i) for i in range(_TRIES)]
    near = [is_near(*each) for each in tries]
    start, goal, turn = tries[-1]
    goal, turn = torch.where(near[-1], 0.25, goal), torch.where(near[-1], math.pi, turn)
    for each, is_too_near in zip(tries[-2::-1], near[-2::-1], strict=True):
        start, goal, turn = (torch.where(is_too_near, o, n) for n, o in zip(each, (start, goal, turn), strict=True))

    angle = 2.0 * math.pi * counter_rng.uniform(key, _DRAW_ANGLE)
    start, goal = LAYOUT_RADIUS * start.sqrt(), LAYOUT_RADIUS * goal.sqrt()
    turn = angle + turn
    return Layout(start * angle.cos(), start * angle.sin(), goal * turn.cos(), goal * turn.sin())


def separation(layout: Layout) -> Tensor:
    """Return the distance (px) between start and goal, `[*B]`."""
    return ((layout.goal_x - layout.start_x).square() + (layout.goal_y - layout.start_y).square()).sqrt()


def fixed_layouts(num: int, seed: int) -> Layout:
    """Draw `num` layouts that no training episode can meet: they come from a stream of their own."""
    zeros = torch.zeros(num, dtype=torch.int32)
    rows = torch.arange(num, dtype=torch.int32)
    return draw_layout(counter_rng.key_for(counter_rng.seed_tensor(seed), counter_rng.EVALUATION, rows, zeros))


def bearing_offset(layout: Layout) -> Tensor:
    """Return degrees `[*B]` in [0, 60] between the goal's bearing and the congruent boat's nearest direction."""
    bearing = torch.rad2deg(torch.atan2(layout.goal_y - layout.start_y, layout.goal_x - layout.start_x))
    # The congruent directions lie at 30, 150 and 270 degrees (y down), 120 apart.
    return ((bearing - 30.0 + 60.0) % 120.0 - 60.0).abs()


def score(outcome: Tensor, fuel: Tensor) -> Tensor:
    """Return the score of finished episodes `[*B]`: 5 x the fuel left (fraction of a tank) on success, else -1."""
    return torch.where(outcome == SUCCESS, 5.0 * fuel, -1.0)


def fuel_fraction(seconds: Tensor) -> Tensor:
    """Return fuel as a fraction of a full tank."""
    return seconds / TANK
