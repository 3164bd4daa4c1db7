"""A point agent in the plane, for one row of a kernel: the rules that Catch Point and Hard Move share."""

from __future__ import annotations

from typing import Any

import numpy as np

from hpamdp.env import point_agent
from hpamdp.env.kernels import ONE, TWO, ZERO, inlined, uniform

X, Y, VX, VY, TARGET_X, TARGET_Y = range(6)

_F = np.float32
_DRAG, _GAIN, _TICK = _F(point_agent._DRAG), _F(point_agent._GAIN), _F(point_agent._TICK)
HIT = _F(point_agent.HIT_RADIUS * point_agent.HIT_RADIUS)
HIT_REWARD = _F(point_agent.HIT_REWARD)


@inlined
def start(floats: Any, row: Any, bits: Any, step: Any) -> None:
    """Place agent and target uniformly in the square."""
    floats[X, row] = TWO * uniform(bits, step, 0) - ONE
    floats[Y, row] = TWO * uniform(bits, step, 1) - ONE
    floats[TARGET_X, row] = TWO * uniform(bits, step, 2) - ONE
    floats[TARGET_Y, row] = TWO * uniform(bits, step, 3) - ONE
    floats[VX, row], floats[VY, row] = ZERO, ZERO


@inlined
def move(floats: Any, row: Any, force_x: Any, force_y: Any) -> Any:
    """Move by one step, and return the squared distance from the target."""
    vx, vy = _DRAG * floats[VX, row] + _GAIN * force_x, _DRAG * floats[VY, row] + _GAIN * force_y
    x, y = floats[X, row] + _TICK * vx, floats[Y, row] + _TICK * vy
    floats[X, row], floats[Y, row], floats[VX, row], floats[VY, row] = x, y, vx, vy
    return (floats[TARGET_X, row] - x) ** 2 + (floats[TARGET_Y, row] - y) ** 2


@inlined
def observe(floats: Any, row: Any, observation: Any) -> None:
    """Write the first four entries of the observation."""
    observation[0], observation[1] = floats[VX, row], floats[VY, row]
    observation[2] = floats[TARGET_X, row] - floats[X, row]
    observation[3] = floats[TARGET_Y, row] - floats[Y, row]
