"""The rules of Catch Point, for columns."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hpamdp.env import point_agent
from hpamdp.env.catch_point.options import PUBLISHED_CATCHES
from hpamdp.env.catch_point.rules import _FORCE, CATCH, CAUGHT, GOING_ON, NO_CATCHES_LEFT, CatchPointState
from hpamdp.env.counter_rng import RngKey
from published_rules import points


def start(episode: Tensor, rng: RngKey) -> CatchPointState:
    """Return the initial states of the episodes with these numbers, int32 `[N]`."""
    x, y, target_x, target_y = points.start(rng)
    zeros = torch.zeros_like(x)
    none = torch.zeros_like(episode)
    return CatchPointState(x, y, zeros, zeros, target_x, target_y, none, none, none, episode)


def act(
    state: CatchPointState, discrete: Tensor, parameter: Tensor, *, catches: int, late_end: bool
) -> tuple[CatchPointState, Tensor]:
    """Return the states after one action in every environment, and the rewards, `[N]`.

    Args:
        state: states before the action.
        discrete: MOVE or CATCH, `[N]`.
        parameter: direction of a move as a fraction of half a turn, clockwise from +y, `[N]`.
        catches: number of failed catches that end an episode.
        late_end: whether the episode ends one step after the last failed catch, as published. The reward of that step
            is 0.
    """
    is_catch = discrete == CATCH
    force = torch.where(is_catch, 0.0, _FORCE).to(parameter.dtype)
    angle = math.pi * parameter
    x, y, vx, vy = points.move(state, force * angle.sin(), force * angle.cos())
    squared = points.squared_distance(state, x, y)
    has_catches = state.misses < catches
    is_hit = is_catch & has_catches & (squared <= point_agent.HIT_RADIUS * point_agent.HIT_RADIUS)
    misses = state.misses + (is_catch & has_catches & ~is_hit).int()
    reward = torch.where(has_catches, torch.where(is_hit, point_agent.HIT_REWARD, 0.0) - squared, 0.0)
    is_lost = ~has_catches if late_end else misses >= catches
    outcome = torch.where(is_lost, NO_CATCHES_LEFT, GOING_ON)
    outcome = torch.where(is_hit, CAUGHT, outcome).int()
    after = state._replace(x=x, y=y, vx=vx, vy=vy, misses=misses, steps=state.steps + 1, outcome=outcome)
    return after, reward


def observe(state: CatchPointState, *, progress: bool) -> Tensor:
    """Return the observation `[N, 4]`: velocity, and target - agent. With `progress` add misses and time, `[N, 6]`."""
    seen = points.observe(state)
    if not progress:
        return seen
    misses = state.misses.clamp(max=PUBLISHED_CATCHES).to(seen.dtype) / 6.0 - 1.0
    time = state.steps.to(seen.dtype) / 12.0 - 1.0
    return torch.cat([seen, torch.stack([misses, time], -1)], -1)
