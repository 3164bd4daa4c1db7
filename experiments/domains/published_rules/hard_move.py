"""The rules of Hard Move, for columns."""

from __future__ import annotations

import torch
from torch import Tensor

from hpamdp.env import point_agent
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.hard_move.rules import _FORCE, GOING_ON, REACHED, HardMoveState
from published_rules import points


def start(episode: Tensor, rng: RngKey) -> HardMoveState:
    """Return the initial states of the episodes with these numbers, int32 `[N]`."""
    x, y, target_x, target_y = points.start(rng)
    zeros = torch.zeros_like(x)
    none = torch.zeros_like(episode)
    return HardMoveState(x, y, zeros, zeros, target_x, target_y, none, none, episode)


def act(state: HardMoveState, discrete: Tensor, parameter: Tensor, motions: Tensor) -> tuple[HardMoveState, Tensor]:
    """Return the states after one action in every environment, and the rewards, `[N]`.

    Args:
        state: states before the action.
        discrete: sets of actuators, int64 `[N]`.
        parameter: strength of the push, `[N]`. Negative values push backwards.
        motions: motions of the sets, `[2^n, 2]`.
    """
    force_x, force_y = (_FORCE * parameter.unsqueeze(-1) * motions[discrete]).unbind(-1)
    x, y, vx, vy = points.move(state, force_x, force_y)
    squared = points.squared_distance(state, x, y)
    is_hit = squared <= point_agent.HIT_RADIUS * point_agent.HIT_RADIUS
    reward = torch.where(is_hit, point_agent.HIT_REWARD, 0.0) - squared
    outcome = torch.where(is_hit, REACHED, GOING_ON).int()
    return state._replace(x=x, y=y, vx=vx, vy=vy, steps=state.steps + 1, outcome=outcome), reward
