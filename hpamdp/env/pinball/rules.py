"""The rules of Pinball as pure functions on columns: a ball, its walls and a hole.

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
import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.pinball.maps import PinballMap
from hpamdp.env.tiles import tiles_of

RIGHT, UP, LEFT, DOWN, NONE = range(5)
ACTIONS = ("right", "up", "left", "down", "none")
PARAMETER_DIMS = (1, 1, 1, 1, 0)
PARAMETER_LOW, PARAMETER_HIGH = (0.0, 0.0, -1.0, -1.0), (1.0, 1.0, 0.0, 0.0)
OUTCOMES = ("rolling", "reached", "time limit")
ROLLING, REACHED, TIME_LIMIT = range(3)
OBSERVATION_NAMES = ("x", "y", "vx", "vy")
REWARD, PUSH_COST, NONE_COST = 10_000.0, 5.0, 1.0

TICKS = 20  # of a step
PUSH = 0.2  # change of the speed by a push of strength 1
MAX_SPEED = 2.0  # on each axis
DRAG = 0.995  # factor on the speed after a step
# A ball touches an edge only if the angle between its velocity and the way to the edge is at most pi / 1.99. The cosine
# is slightly negative, so a ball that rolls along an edge touches it.
_COSINE = math.cos(math.pi / 1.99)
TOUCHING = _COSINE * _COSINE
LOW_PLACE, HIGH_PLACE = 0.05, 0.95  # where a ball is put that has left the square


class PinballState(NamedTuple):
    """The state of N environments, columns `[N]`: position, velocity, and the counters of the episode."""

    x: Tensor
    y: Tensor
    vx: Tensor
    vy: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


class Table(NamedTuple):
    """A map as tensors, with E edges of P polygons.

    Attributes:
        ball: radius of the ball.
        target: x, y and radius of the hole.
        places: where a ball may start in training, `[T, 2]`, and in evaluation, `[S, 2]`.
        corner_x, corner_y: where each edge begins, `[E]`.
        side_x, side_y: from there to its end, `[E]`.
        squared: squared lengths of the edges, `[E]`.
        belongs: 1 if the edge belongs to the polygon, else 0, `[E, P]`.
    """

    ball: float
    target: tuple[float, float, float]
    places: tuple[Tensor, Tensor]
    corner_x: Tensor
    corner_y: Tensor
    side_x: Tensor
    side_y: Tensor
    squared: Tensor
    belongs: Tensor


def make_table(
    found: PinballMap,
    places: tuple[np.ndarray, np.ndarray],
    device: Any = None,
    dtype: torch.dtype = torch.float32,
) -> Table:
    """Return a map as tensors, with the places where a ball may start; see `Table`."""
    edges = found.edges()

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(device=device, dtype=dtype)

    return Table(
        ball=found.ball,
        target=found.target,
        places=(tensor(places[0]), tensor(places[1])),
        corner_x=tensor(edges.corner[:, 0]),
        corner_y=tensor(edges.corner[:, 1]),
        side_x=tensor(edges.side[:, 0]),
        side_y=tensor(edges.side[:, 1]),
        squared=tensor((edges.side**2).sum(-1)),
        belongs=tensor(edges.polygon[:, None] == np.arange(len(found.polygons))),
    )


def start(episode: Tensor, rng: RngKey, table: Table, *, is_training: bool) -> PinballState:
    """Return the initial states of the episodes with these numbers, int32 `[N]`: at rest in one of the places."""
    places = table.places[0 if is_training else 1]
    num = len(places)
    place = (counter_rng.uniform(rng, 0) * num).long().clamp(max=num - 1)
    x, y = places[place].unbind(-1)
    nothing = torch.zeros_like(episode)
    return PinballState(x, y, torch.zeros_like(x), torch.zeros_like(y), nothing, nothing + ROLLING, episode)


def act(state: PinballState, discrete: Tensor, strength: Tensor, table: Table) -> tuple[PinballState, Tensor]:
    """Return the states after one step in every environment, and the rewards, `[N]`.

    Args:
        state: states before the step.
        discrete: RIGHT, UP, LEFT, DOWN or NONE, `[N]`.
        strength: strength of the push within its bounds, `[N]`; not read with NONE.
        table: the map.
    """
    x, y = state.x, state.y
    push = strength * PUSH
    nothing = torch.zeros_like(push)
    vx = state.vx + torch.where((discrete == RIGHT) | (discrete == LEFT), push, nothing)
    vy = state.vy + torch.where((discrete == UP) | (discrete == DOWN), push, nothing)
    is_reached = torch.zeros_like(x, dtype=torch.bool)
    for tick in range(TICKS):
        x, y = _moved(x, y, vx, vy, ~is_reached, table)
        touches = _touches(x, y, vx, vy, table) & ~is_reached.unsqueeze(-1)
        vx, vy = _bounced(vx, vy, touches, table)
        if tick == TICKS - 1:
            num_polygons = ((touches.to(x.dtype) @ table.belongs) > 0.0).sum(-1)
            x, y = _moved(x, y, vx, vy, num_polygons == 1, table)
        target_x, target_y, radius = table.target
        is_reached = is_reached | ((x - target_x).square() + (y - target_y).square() < radius * radius)
    vx, vy = (torch.where(is_reached, speed, DRAG * speed).clamp(-MAX_SPEED, MAX_SPEED) for speed in (vx, vy))
    x, y = (torch.where(is_reached, place, _put_back(place)) for place in (x, y))
    reward = torch.where(is_reached, REWARD, torch.where(discrete == NONE, -NONE_COST, -PUSH_COST)).to(x.dtype)
    outcome = torch.where(is_reached, REACHED, ROLLING).to(torch.int32)
    return PinballState(x, y, vx, vy, state.steps + 1, outcome, state.episode), reward


def _moved(x: Tensor, y: Tensor, vx: Tensor, vy: Tensor, moves: Tensor, table: Table) -> tuple[Tensor, Tensor]:
    """Return the positions a tick later where `moves`, `[N]` each."""
    return (
        torch.where(moves, x + vx * table.ball / TICKS, x),
        torch.where(moves, y + vy * table.ball / TICKS, y),
    )


def _touches(x: Tensor, y: Tensor, vx: Tensor, vy: Tensor, table: Table) -> Tensor:
    """Return which edges the balls touch and do not already leave, bool `[N, E]`."""
    x, y, vx, vy = (column.unsqueeze(-1) for column in (x, y, vx, vy))
    along = ((x - table.corner_x) * table.side_x + (y - table.corner_y) * table.side_y) / table.squared
    along = along.clamp(0.0, 1.0)
    # From the ball to the nearest point of the edge.
    to_x = table.corner_x + along * table.side_x - x
    to_y = table.corner_y + along * table.side_y - y
    squared = to_x.square() + to_y.square()
    towards = to_x * vx + to_y * vy
    is_turned = (towards >= 0.0) | (towards.square() <= TOUCHING * squared * (vx.square() + vy.square()))
    return (squared <= table.ball * table.ball) & is_turned


def _bounced(vx: Tensor, vy: Tensor, touches: Tensor, table: Table) -> tuple[Tensor, Tensor]:
    """Return the velocities `[N]` after the balls have touched edges: mirrored at one, reversed by several."""
    num = touches.sum(-1)
    # Sums find the touched edge without an index. Compiled code would check an index even if no edge is touched.
    side_x, side_y, squared = (
        torch.where(touches, each, 0.0).sum(-1) for each in (table.side_x, table.side_y, table.squared)
    )
    double = 2.0 * (vx * side_x + vy * side_y) / torch.where(num > 0, squared, 1.0)
    bounced_x = torch.where(num > 1, -vx, double * side_x - vx)
    bounced_y = torch.where(num > 1, -vy, double * side_y - vy)
    return torch.where(num > 0, bounced_x, vx), torch.where(num > 0, bounced_y, vy)


def _put_back(place: Tensor) -> Tensor:
    """Return coordinates `[N]` inside the square."""
    place = torch.where(place > 1.0, HIGH_PLACE, place)
    return torch.where(place < 0.0, LOW_PLACE, place)


def observe(state: PinballState, tiles: int = 0) -> Tensor:
    """Return the observation `[N, 4 + 2 tiles]`.

    It has the entries OBSERVATION_NAMES, scaled to [-1, 1], then x and y again as tiles, see `hpamdp.env.tiles`.
    """
    place = torch.stack([state.x, state.y], -1)
    speed = torch.stack([state.vx, state.vy], -1)
    return torch.cat([2.0 * place - 1.0, speed / MAX_SPEED, tiles_of(state.x, state.y, tiles)], -1)
