"""CartPole-v1 as a problem with a kernel: keep a pole upright on a cart that is pushed to the left or to the right.

The rules are those of Gymnasium's CartPole-v1. The discrete actions have no parameters.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import PositiveInt
from torch import Tensor

from hpamdp.env import kernels
from hpamdp.env.batched_env import KernelEnv
from hpamdp.env.kernels import OUTCOME_ROW, kernel
from hpamdp.settings import Settings

OUTCOMES = ("balancing", "success", "fallen", "time limit")  # CartPole has no success
BALANCING, _, FALLEN, _ = range(4)
X, X_DOT, THETA, THETA_DOT = range(4)  # rows of the state
LEFT = 0

_F = np.float32
_GRAVITY, _FORCE, _TAU = _F(9.8), _F(10.0), _F(0.02)
_POLE_MASS, _TOTAL_MASS, _LENGTH = _F(0.1), _F(1.1), _F(0.5)
_POLE_MOMENT = _F(0.05)
_X_LIMIT, _THETA_LIMIT = _F(2.4), _F(12.0 * 2.0 * math.pi / 360.0)
_FOUR_THIRDS, _START = _F(4.0 / 3.0), _F(0.05)


@kernel
def advance(
    state: Any, option: Any, discrete: Any, parameters: Any, mask: Any, settings: Any, mode: Any, results: Any
) -> int:
    """Push or restart in every row, in place; see `hpamdp.env.kernel_rows`."""
    floats, integers = state
    observations, outcomes, _, flags, rewards = results
    invalid = kernels.invalid_row(option, discrete, parameters, integers, settings, mode)
    if invalid >= 0:
        return invalid
    for row in range(len(mask)):
        was_over = integers[OUTCOME_ROW, row] != BALANCING
        if mode != kernels.RESTART and mask[row] and not was_over:
            force = -_FORCE if discrete[row] == LEFT else _FORCE
            theta, theta_dot = floats[THETA, row], floats[THETA_DOT, row]
            sine, cosine = kernels.sin_cos(theta)
            push = (force + _POLE_MOMENT * theta_dot * theta_dot * sine) / _TOTAL_MASS
            inertia = _LENGTH * (_FOUR_THIRDS - _POLE_MASS * cosine * cosine / _TOTAL_MASS)
            theta_acceleration = (_GRAVITY * sine - cosine * push) / inertia
            x_acceleration = push - _POLE_MOMENT * theta_acceleration * cosine / _TOTAL_MASS
            floats[X, row] += _TAU * floats[X_DOT, row]
            floats[X_DOT, row] += _TAU * x_acceleration
            floats[THETA, row] = theta + _TAU * theta_dot
            floats[THETA_DOT, row] = theta_dot + _TAU * theta_acceleration
            has_fallen = (abs(floats[X, row]) > _X_LIMIT) | (abs(floats[THETA, row]) > _THETA_LIMIT)
            rewards[row] = kernels.ONE
            kernels.end_step(integers, row, FALLEN if has_fallen else BALANCING, len(OUTCOMES), settings)
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                bits, step = kernels.new_episode(integers, row, settings)
                for column in range(4):
                    floats[column, row] = _START * (kernels.TWO * kernels.uniform(bits, step, column) - kernels.ONE)
            for column in range(4):
                observations[reading, row, column] = floats[column, row]
            kernels.report(integers[OUTCOME_ROW, row], len(OUTCOMES), row, outcomes[reading], flags[reading])
    return -1


class CartPoleOptions(Settings):
    """Settings of `CartPoleEnv`."""

    max_steps: PositiveInt = 500
    """Steps after which an episode is truncated."""


class CartPoleState(NamedTuple):
    """Columns `[N]`: the cart's position and velocity, the pole's angle and its velocity, then int32 counters."""

    x: Tensor
    x_dot: Tensor
    theta: Tensor
    theta_dot: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


class CartPoleEnv(KernelEnv[CartPoleState]):
    """Balance the poles of `num_envs` carts."""

    Options = CartPoleOptions
    outcomes: ClassVar[tuple[str, ...]] = OUTCOMES
    observation_names = ("x", "x_dot", "theta", "theta_dot")
    discrete_names = ("left", "right")
    parameter_dims = (0, 0)
    parameter_low: ClassVar[tuple[float, ...]] = ()
    parameter_high: ClassVar[tuple[float, ...]] = ()
    row_kernel = staticmethod(advance)
    state_type = CartPoleState
    num_columns = (4, 3)
