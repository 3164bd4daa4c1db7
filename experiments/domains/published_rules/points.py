"""The rules that Catch Point and Hard Move share, for columns."""

from __future__ import annotations

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.point_agent import _DRAG, _GAIN, _TICK, PointState


def start(rng: RngKey) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return x and y of the agent and of the target, uniform in (-1, 1), `[N]` each."""
    x, y, target_x, target_y = (2.0 * counter_rng.uniform(rng, index) - 1.0 for index in range(4))
    return x, y, target_x, target_y


def move(state: PointState, force_x: Tensor, force_y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return x, y, vx and vy after one step under a force, `[N]` each."""
    vx = _DRAG * state.vx + _GAIN * force_x
    vy = _DRAG * state.vy + _GAIN * force_y
    return state.x + _TICK * vx, state.y + _TICK * vy, vx, vy


def squared_distance(state: PointState, x: Tensor, y: Tensor) -> Tensor:
    """Return the squared distance `[N]` between the target and an agent at (x, y)."""
    return (state.target_x - x).square() + (state.target_y - y).square()


def observe(state: PointState) -> Tensor:
    """Return the observation `[N, 4]` with the entries OBSERVATION_NAMES."""
    return torch.stack([state.vx, state.vy, state.target_x - state.x, state.target_y - state.y], -1)
