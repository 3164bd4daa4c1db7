"""The rules of Pinball for one row, and the loop over all rows that Numba compiles: a ball, its walls and a hole.

Before a step a row collects the edges that its ball can reach in this step. Most balls reach none, and the others a
few, so the ticks test only these.

Source: Konidaris and Barto 2009, *Skill discovery in continuous reinforcement learning domains using skill chaining*,
with pushes of any strength as in PEARL, arXiv:2512.20831.
Differs from the source:
- Observations are scaled to [-1, 1].
- A ball bounces off an edge by a mirrored vector, and whether it moves towards the edge is told by a dot product. The
  source does both with angles, which is equal up to rounding.
- Strengths outside their bounds are clipped.
- The time limit truncates.
- With `tiles` the observation also has the position as tiles.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from hpamdp.env import kernels
from hpamdp.env.kernels import ONE, OUTCOME_ROW, TWO, ZERO, kernel, part
from hpamdp.env.pinball.maps import PinballMap
from hpamdp.env.rng_streams import TRAINING
from hpamdp.env.tiles import write_tiles

RIGHT, UP, LEFT, DOWN, NONE = range(5)
ACTIONS = ("right", "up", "left", "down", "none")
PARAMETER_DIMS = (1, 1, 1, 1, 0)
PARAMETER_LOW, PARAMETER_HIGH = (0.0, 0.0, -1.0, -1.0), (1.0, 1.0, 0.0, 0.0)
OUTCOMES = ("rolling", "reached", "time limit")
ROLLING, REACHED, TIME_LIMIT = range(3)
OBSERVATION_NAMES = ("x", "y", "vx", "vy")
REWARD, PUSH_COST, NONE_COST = 10_000.0, 5.0, 1.0

PUSH = 0.2  # change of the speed by a push of strength 1
_F = np.float32
_PUSH = _F(PUSH)
_NUM_TICKS, _TICKS = 20, _F(20.0)  # of a step
_MAX_SPEED = _F(2.0)  # on each axis
_DRAG = _F(0.995)  # factor on the speed after a step
# A ball touches an edge only if the angle between its velocity and the way to the edge is at most pi / 1.99. The cosine
# is slightly negative, so a ball that rolls along an edge touches it.
_TOUCHING = _F(math.cos(math.pi / 1.99) ** 2)
_LOW, _HIGH = _F(0.05), _F(0.95)  # where a ball is put that has left the square
_MOVES = _F(21.0 / 20.0)  # of a step, with that after a touch in its last tick
_SLACK = _F(1e-4)  # for rounding

# The problem's own settings: the tiles that are observed, and the map. After these numbers follow the polygons, the
# edges, and the places to start: those of training, then those of evaluation.
TILES, BALL, TARGET_X, TARGET_Y, TARGET_RADIUS, NUM_POLYGONS, NUM_EDGES, NUM_TRAINING, NUM_PLACES = range(
    kernels.OWN, kernels.OWN + 9
)
_FIRST = NUM_PLACES + 1

_X, _Y, _VX, _VY = range(4)
# Columns of a polygon: its edges, and the box around it.
_BEGIN, _END, _MIN_X, _MAX_X, _MIN_Y, _MAX_Y = range(6)
# Columns of an edge.
_CORNER_X, _CORNER_Y, _SIDE_X, _SIDE_Y, _SQUARED, _POLYGON = range(6)


class PinballState(NamedTuple):
    """The state of N environments, columns `[N]`: position, velocity, and the counters of the episode."""

    x: Tensor
    y: Tensor
    vx: Tensor
    vy: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


def settings_of(found: PinballMap, places: tuple[np.ndarray, np.ndarray], tiles: int) -> list[float]:
    """Return the number of tiles, a map and the places to start as the kernel's own settings."""
    edges = found.edges()
    polygons, begin = [], 0
    for polygon in found.polygons:
        x, y = zip(*polygon, strict=True)
        polygons.append([begin, begin + len(polygon), min(x), max(x), min(y), max(y)])
        begin += len(polygon)
    columns = [*edges.corner.T, *edges.side.T, (edges.side**2).sum(-1), edges.polygon]
    return [
        tiles,
        found.ball,
        *found.target,
        len(polygons),
        begin,
        len(places[0]),
        len(places[1]),
        *np.array(polygons, np.float64).ravel().tolist(),
        *np.stack(columns, -1).ravel().tolist(),
        *np.concatenate(places).ravel().tolist(),
    ]


@part
def _collect(x: Any, y: Any, reach: Any, polygons: Any, edges: Any, near: Any) -> Any:
    """Write the numbers of the edges within reach, and return how many there are."""
    num = 0
    for each in range(len(polygons)):
        polygon = polygons[each]
        is_far = (x + reach < polygon[_MIN_X]) | (x - reach > polygon[_MAX_X])
        is_far |= (y + reach < polygon[_MIN_Y]) | (y - reach > polygon[_MAX_Y])
        if is_far:
            continue
        for number in range(int(polygon[_BEGIN]), int(polygon[_END])):
            edge = edges[number]
            along = (x - edge[_CORNER_X]) * edge[_SIDE_X] + (y - edge[_CORNER_Y]) * edge[_SIDE_Y]
            along = min(max(along / edge[_SQUARED], ZERO), ONE)
            to_x, to_y = edge[_CORNER_X] + along * edge[_SIDE_X] - x, edge[_CORNER_Y] + along * edge[_SIDE_Y] - y
            if to_x * to_x + to_y * to_y <= reach * reach:
                near[num] = number
                num += 1
    return num


@part
def _touch(x: Any, y: Any, vx: Any, vy: Any, ball: Any, edges: Any, near: Any, num: Any) -> Any:
    """Return how many edges the ball touches, one of them, and whether they are several polygons'."""
    count, touched, is_several = 0, 0, False
    for place in range(num):
        number = near[place]
        edge = edges[number]
        along = (x - edge[_CORNER_X]) * edge[_SIDE_X] + (y - edge[_CORNER_Y]) * edge[_SIDE_Y]
        along = min(max(along / edge[_SQUARED], ZERO), ONE)
        to_x, to_y = edge[_CORNER_X] + along * edge[_SIDE_X] - x, edge[_CORNER_Y] + along * edge[_SIDE_Y] - y
        squared = to_x * to_x + to_y * to_y
        if squared > ball * ball:
            continue
        towards = to_x * vx + to_y * vy
        if towards >= ZERO or towards * towards <= _TOUCHING * squared * (vx * vx + vy * vy):
            is_several |= count > 0 and edges[touched, _POLYGON] != edge[_POLYGON]
            count, touched = count + 1, number
    return count, touched, is_several


@part
def _roll(floats: Any, row: Any, settings: Any, polygons: Any, edges: Any, near: Any) -> Any:
    """Roll a row's ball for a step and return its outcome."""
    x, y, vx, vy = floats[_X, row], floats[_Y, row], floats[_VX, row], floats[_VY, row]
    ball, radius = _F(settings[BALL]), _F(settings[TARGET_RADIUS])
    target_x, target_y = _F(settings[TARGET_X]), _F(settings[TARGET_Y])
    travel = _MOVES * ball * _F(np.sqrt(vx * vx + vy * vy)) + _SLACK
    num = _collect(x, y, ball + travel, polygons, edges, near)
    outcome = ROLLING
    for tick in range(_NUM_TICKS):
        x, y = x + vx * ball / _TICKS, y + vy * ball / _TICKS
        count, touched, is_several = _touch(x, y, vx, vy, ball, edges, near, num)
        if count == 1:
            edge = edges[touched]
            double = TWO * (vx * edge[_SIDE_X] + vy * edge[_SIDE_Y]) / edge[_SQUARED]
            vx, vy = double * edge[_SIDE_X] - vx, double * edge[_SIDE_Y] - vy
        elif count > 1:
            vx, vy = -vx, -vy
        if count > 0 and not is_several and tick == _NUM_TICKS - 1:
            x, y = x + vx * ball / _TICKS, y + vy * ball / _TICKS
        to_x, to_y = x - target_x, y - target_y
        if to_x * to_x + to_y * to_y < radius * radius:
            outcome = REACHED
            break
    if outcome == ROLLING:
        vx, vy = _DRAG * vx, _DRAG * vy
        x = _HIGH if x > ONE else (_LOW if x < ZERO else x)
        y = _HIGH if y > ONE else (_LOW if y < ZERO else y)
    floats[_X, row], floats[_Y, row] = x, y
    floats[_VX, row] = min(max(vx, -_MAX_SPEED), _MAX_SPEED)
    floats[_VY, row] = min(max(vy, -_MAX_SPEED), _MAX_SPEED)
    return outcome


@part
def _start(floats: Any, row: Any, places: Any, bits: Any, step: Any) -> None:
    """Put a ball where an episode begins."""
    place = min(int(kernels.uniform(bits, step, 0) * _F(len(places))), len(places) - 1)
    floats[_X, row], floats[_Y, row] = _F(places[place, 0]), _F(places[place, 1])
    floats[_VX, row], floats[_VY, row] = ZERO, ZERO


@kernel
def advance(
    state: Any, option: Any, discrete: Any, parameters: Any, mask: Any, settings: Any, mode: Any, results: Any
) -> int:
    """Act or restart in every row, in place; see `hpamdp.env.kernel_rows`."""
    floats, integers = state
    observations, outcomes, _, flags, rewards = results
    invalid = kernels.invalid_row(option, discrete, parameters, integers, settings, mode)
    if invalid >= 0:
        return invalid
    end_polygons = _FIRST + 6 * int(settings[NUM_POLYGONS])
    end_edges = end_polygons + 6 * int(settings[NUM_EDGES])
    polygons = settings[_FIRST:end_polygons].astype(np.float32).reshape((-1, 6))
    edges = settings[end_polygons:end_edges].astype(np.float32).reshape((-1, 6))
    end_training = end_edges + 2 * int(settings[NUM_TRAINING])
    begin, end = end_training, end_training + 2 * int(settings[NUM_PLACES])
    if settings[kernels.EPISODE_STREAM] == TRAINING:
        begin, end = end_edges, end_training
    starts = settings[begin:end].reshape((-1, 2))
    near = np.empty(len(edges), np.int64)
    tiles = int(settings[TILES])
    for row in range(len(mask)):
        was_over = integers[OUTCOME_ROW, row] != ROLLING
        if mode != kernels.RESTART and mask[row] and not was_over:
            action = discrete[row]
            push = _PUSH * kernels.parameter(parameters, row, 0, action)
            if action in (RIGHT, LEFT):
                floats[_VX, row] += push
            elif action != NONE:
                floats[_VY, row] += push
            outcome = _roll(floats, row, settings, polygons, edges, near)
            kernels.end_step(integers, row, outcome, len(OUTCOMES), settings)
            cost = NONE_COST if action == NONE else PUSH_COST
            rewards[row] = REWARD if outcome == REACHED else -cost
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                bits, step = kernels.new_episode(integers, row, settings)
                _start(floats, row, starts, bits, step)
            observations[reading, row, 0] = TWO * floats[_X, row] - ONE
            observations[reading, row, 1] = TWO * floats[_Y, row] - ONE
            observations[reading, row, 2] = floats[_VX, row] / _MAX_SPEED
            observations[reading, row, 3] = floats[_VY, row] / _MAX_SPEED
            write_tiles(floats[_X, row], floats[_Y, row], tiles, observations[reading, row], len(OBSERVATION_NAMES))
            kernels.report(integers[OUTCOME_ROW, row], len(OUTCOMES), row, outcomes[reading], flags[reading])
    return -1
