"""The constants of Moving and Sliding, the columns of their state, and their hand-written player.

`kernel` has the rules.

Source: Xiong et al. 2018, arXiv:1810.06394, and Fan et al. 2019, arXiv:1903.01344, in the version of gym-hybrid
(T. Hirtz).
Differs from gym-hybrid: in Sliding, an episode starts with the course equal to the heading.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

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


def distance(state: VehicleState) -> Tensor:
    """Return the distance from the target, `[N]`."""
    return ((state.target_x - state.x).square() + (state.target_y - state.y).square()).sqrt()


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
