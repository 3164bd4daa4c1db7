"""The rules of Moving and Sliding as pure functions on columns, in the dtype of the state.

Source: Xiong et al. 2018, arXiv:1810.06394, and Fan et al. 2019, arXiv:1903.01344, in the version of gym-hybrid
(T. Hirtz).
Differs from gym-hybrid: in Sliding, an episode starts with the course equal to the heading.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.counter_rng import RngKey

ACCELERATE, TURN, BRAKE = range(3)
ACTIONS = ("accelerate", "turn", "brake")
PARAMETER_LOW, PARAMETER_HIGH = (0.0, -1.0), (1.0, 1.0)
OUTCOMES = ("going on", "stopped at the target", "left the field", "time limit")
GOING_ON, STOPPED, LEFT_FIELD, TIME_LIMIT = range(4)
OBSERVATION_NAMES = (
    "x",
    "y",
    "speed",
    "cos_heading",
    "sin_heading",
    "target_x",
    "target_y",
    "distance",
    "inside",
    "time_share",
)
VECTORS = ((0, 1), (3, 4), (5, 6))  # places of (x, y) pairs in the observation
TARGET_RADIUS = 0.1
LARGEST_PUSH = 0.5  # the most that an acceleration adds to the speed
STEP = 0.005  # distance covered in a step at speed 1
_BRAKE = 0.1
_TURN = math.pi / 2.0
_TARGET_BOUND = 0.9  # bound of the target's coordinates
_STEP_COST = 0.001
_SUCCESS_REWARD, _FAILURE_REWARD = 1.0, -1.0


class VehicleState(NamedTuple):
    """The state of N environments, columns `[N]`.

    It holds the vehicle's position, speed, heading and course (rad), the target's position, and int32 counters. In
    Moving the course equals the heading.
    """

    x: Tensor
    y: Tensor
    speed: Tensor
    heading: Tensor
    course: Tensor
    target_x: Tensor
    target_y: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


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


def distance(state: VehicleState) -> Tensor:
    """Return the distance from the target, `[N]`."""
    return ((state.target_x - state.x).square() + (state.target_y - state.y).square()).sqrt()


def observe(state: VehicleState, max_steps: int) -> Tensor:
    """Return the observation `[N, 10]` with the entries OBSERVATION_NAMES, for episodes of `max_steps` actions."""
    remaining = distance(state)
    inside = (remaining <= TARGET_RADIUS).to(remaining.dtype)
    time = state.steps.to(remaining.dtype) / max(max_steps - 1, 1)
    cos, sin = state.heading.cos(), state.heading.sin()
    seen = [state.x, state.y, state.speed, cos, sin, state.target_x, state.target_y, remaining, inside, time]
    return torch.stack(seen, -1)


def observation_bounds(max_steps: int) -> tuple[list[float], list[float]]:
    """Return the lowest and the highest observation that this many steps can reach."""
    speed = LARGEST_PUSH * max_steps
    # The last step may leave the field. The extra 0.001 allows for rounding.
    edge = 1.001 + STEP * speed
    furthest = math.sqrt(2.0) * (edge + _TARGET_BOUND)
    latest = 1.001 * max_steps / max(max_steps - 1, 1)
    high = [edge, edge, speed, 1.001, 1.001, _TARGET_BOUND, _TARGET_BOUND, furthest, 1.0, latest]
    low = [-edge, -edge, 0.0, -1.001, -1.001, -_TARGET_BOUND, -_TARGET_BOUND, 0.0, 0.0, 0.0]
    return low, high


# The hand-written player's travelling speed, tolerated error of the heading (rad), and margin for braking.
_CRUISE = 2.5
_TOLERANCE = 0.01
_MARGIN = 0.05


def scripted_action(state: VehicleState) -> tuple[Tensor, Tensor]:
    """Return the discrete action and the parameter of a hand-written player, `[N]` each.

    It turns towards the target, accelerates, and brakes in time. It turns only at rest, so it also works in Sliding.
    """
    remaining = distance(state)
    bearing = torch.atan2(state.target_y - state.y, state.target_x - state.x)
    error = (bearing - state.heading + math.pi).remainder(2.0 * math.pi) - math.pi
    stops_within = 0.5 * STEP / _BRAKE * state.speed * (state.speed + _BRAKE) + _MARGIN
    must_brake = remaining <= stops_within
    must_turn = (error.abs() > _TOLERANCE) & (state.speed == 0.0)
    # At travelling speed the vehicle turns by 0, because no action does nothing.
    can_speed_up = state.speed < _CRUISE
    discrete = torch.where(can_speed_up, ACCELERATE, TURN)
    parameter = torch.where(can_speed_up, ((_CRUISE - state.speed) / LARGEST_PUSH).clamp(0.0, 1.0), 0.0)
    discrete = torch.where(must_turn, TURN, discrete)
    parameter = torch.where(must_turn, (error / _TURN).clamp(-1.0, 1.0), parameter)
    return torch.where(must_brake, BRAKE, discrete), torch.where(must_brake, 0.0, parameter)
