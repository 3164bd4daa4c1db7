"""The rules of Moving and Sliding, for columns."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.gym_hybrid.rules import (
    _BRAKE,
    _FAILURE_REWARD,
    _STEP_COST,
    _SUCCESS_REWARD,
    _TARGET_BOUND,
    _TURN,
    ACCELERATE,
    BRAKE,
    GOING_ON,
    LARGEST_PUSH,
    LEFT_FIELD,
    STEP,
    STOPPED,
    TARGET_RADIUS,
    TIME_LIMIT,
    TURN,
    VehicleState,
    distance,
)


def start(episode: Tensor, rng: RngKey) -> VehicleState:
    """Return the initial states of the episodes with these numbers, int32 `[N]`."""
    target_x, target_y = (_TARGET_BOUND * (2.0 * counter_rng.uniform(rng, index) - 1.0) for index in range(2))
    x, y = (2.0 * counter_rng.uniform(rng, index) - 1.0 for index in range(2, 4))
    heading = 2.0 * math.pi * counter_rng.uniform(rng, 4)
    zeros = torch.zeros_like(episode)
    return VehicleState(x, y, torch.zeros_like(x), heading, heading, target_x, target_y, zeros, zeros, episode)


def act(
    state: VehicleState, discrete: Tensor, parameter: Tensor, *, slides: bool, max_steps: int
) -> tuple[VehicleState, Tensor]:
    """Return the states after one action in every environment, and the rewards, `[N]`.

    Args:
        state: states before the action.
        discrete: ACCELERATE, TURN or BRAKE, `[N]`.
        parameter: parameter of the chosen action, within its bounds, `[N]`.
        slides: whether the vehicle keeps its course when it turns (Sliding).
        max_steps: number of actions after which an episode ends. Unless the last one succeeds, its reward is that of a
            failure.
    """
    steer = _slide if slides else _follow
    speed, heading, course = steer(state, discrete, parameter)
    x = state.x + STEP * speed * course.cos()
    y = state.y + STEP * speed * course.sin()
    steps = state.steps + 1
    after = state._replace(x=x, y=y, speed=speed, heading=heading, course=course, steps=steps)
    remaining = distance(after)
    has_stopped = (remaining < TARGET_RADIUS) & (speed == 0.0)
    is_outside = (x.abs() > 1.0) | (y.abs() > 1.0)
    is_late = steps >= max_steps
    reward = distance(state) - remaining - _STEP_COST
    reward = torch.where(is_outside | is_late, _FAILURE_REWARD, reward)
    reward = torch.where(has_stopped, distance(state) - remaining - _STEP_COST + _SUCCESS_REWARD, reward)
    outcome = torch.where(is_late, TIME_LIMIT, GOING_ON)
    outcome = torch.where(is_outside, LEFT_FIELD, outcome)
    outcome = torch.where(has_stopped, STOPPED, outcome).int()
    return after._replace(outcome=outcome), reward


def _follow(state: VehicleState, discrete: Tensor, parameter: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return speed, heading and course after an action in Moving."""
    faster = state.speed + LARGEST_PUSH * parameter
    speed = torch.where(discrete == ACCELERATE, faster, _braked(state.speed, discrete))
    heading = _turned(state.heading, discrete, parameter)
    return speed, heading, heading


def _slide(state: VehicleState, discrete: Tensor, parameter: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return speed, heading and course after an action in Sliding.

    An acceleration adds a vector along the heading to the velocity.
    """
    is_push = discrete == ACCELERATE
    push = LARGEST_PUSH * parameter
    drift = state.course - state.heading
    along = push + state.speed * drift.cos()
    across = state.speed * drift.sin()
    squared = push.square() + state.speed.square() + 2.0 * push * state.speed * drift.cos()
    # Rounding can make the square negative.
    faster = squared.clamp(min=0.0).sqrt()
    speed = torch.where(is_push, faster, _braked(state.speed, discrete))
    heading = _turned(state.heading, discrete, parameter)
    course = torch.where(is_push, state.heading + torch.atan2(across, along), state.course)
    return speed, heading, torch.where((discrete == BRAKE) & (speed == 0.0), heading, course)


def _braked(speed: Tensor, discrete: Tensor) -> Tensor:
    slower = torch.where(speed < _BRAKE, 0.0, speed - _BRAKE)
    return torch.where(discrete == BRAKE, slower, speed)


def _turned(heading: Tensor, discrete: Tensor, parameter: Tensor) -> Tensor:
    return torch.where(discrete == TURN, (heading + _TURN * parameter).remainder(2.0 * math.pi), heading)


def observe(state: VehicleState, max_steps: int) -> Tensor:
    """Return the observation `[N, 10]` with the entries OBSERVATION_NAMES, for episodes of `max_steps` actions."""
    remaining = distance(state)
    inside = (remaining <= TARGET_RADIUS).to(remaining.dtype)
    time = state.steps.to(remaining.dtype) / max(max_steps - 1, 1)
    cos, sin = state.heading.cos(), state.heading.sin()
    seen = [state.x, state.y, state.speed, cos, sin, state.target_x, state.target_y, remaining, inside, time]
    return torch.stack(seen, -1)
