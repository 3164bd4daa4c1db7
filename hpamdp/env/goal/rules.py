"""The constants of the Robot Soccer Goal domain and the columns of its state. `kernel` has the rules.

Source: Masson, Ranchod & Konidaris 2016, arXiv:1509.01644, section on the Robot Soccer Goal domain. Constants, bounds
and rules as in gym-goal, the version of Bester, James & Konidaris 2019, arXiv:1905.04388, with the three observations
that their learners add. The shots of Hard Goal are as in HyAR, Li et al. 2022, arXiv:2109.05490.
Differs from the source: the player's reach has a small tolerance. At the start the ball lies exactly at the reach, and
rounding in float32 would put every fifth ball outside. Two bodies in exactly the same place do not push each other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor

KICK_TO, SHOOT_LEFT, SHOOT_RIGHT = range(3)
PARAMETER_DIMS = (2, 1, 1)
OUTCOMES = ("playing", "goal", "caught", "out", "time limit")
PLAYING, GOAL, CAUGHT, OUT, TIME_LIMIT = range(5)
GOAL_REWARD = 50.0

# Half a pitch, its goal at the far end. Velocities are per tick.
LENGTH, HALF_WIDTH = 20.0, 15.0
GOAL_HALF_WIDTH, GOAL_DEPTH = 7.01, 2.44
_FLOAT32_GOAL = 7.010000228881836  # the bound of the published action and observation spaces
PARAMETER_LOW = (0.0, -HALF_WIDTH, -_FLOAT32_GOAL, -_FLOAT32_GOAL)
PARAMETER_HIGH = (2.0 * LENGTH, HALF_WIDTH, _FLOAT32_GOAL, _FLOAT32_GOAL)
PLAYER_SIZE, KEEPER_SIZE, BALL_SIZE = 0.9, 0.9, 0.4
REACH = 1.6
CATCH = 2.0  # the keeper catches a ball nearer than this
_REACH_SLACK = 1e-5
_PLAYER_DECAY, _BALL_DECAY = 0.4, 0.94  # factors on the velocities after each tick
_PLAYER_NOISE, _BALL_NOISE = 0.1, 0.05
_PLAYER_SPEED, _BALL_SPEED = 1.0, 2.7  # limits of velocities, and of their change in a tick, in x and in y
_PLAYER_RATE, _BALL_RATE = 0.006, 0.027  # change of velocity per unit of power
_MAX_POWER = 100.0
_DASH, _SAVE, _FOLLOW = 10.0 * _PLAYER_RATE, 20.0 * _PLAYER_RATE, 8.0 * _PLAYER_RATE
_FACING = math.pi / 8
_SHOT_DEPTH = 0.4  # distance behind the goal line at which shots are aimed
_KEEPER_START = 14.5
_KEEPER_MARGIN = 2.0  # the keeper defends shots up to this far beside the goal
_STILL = 0.1  # a kick is over when the ball is this slow
_COAST = 1.0 - _BALL_DECAY  # a ball rolls another velocity / _COAST before it stops

OBSERVATION_NAMES = (
    "player_x",
    "player_y",
    "player_vx",
    "player_vy",
    "player_angle",
    "keeper_x",
    "keeper_y",
    "keeper_vx",
    "keeper_vy",
    "keeper_angle",
    "ball_x",
    "ball_y",
    "ball_vx",
    "ball_vy",
    "keeper_to_ball_x",
    "keeper_to_ball_y",
    "keeper_projection",
)
_FLOAT32_PI = 3.1415927410125732
_BODY_LOW, _BODY_HIGH = (0.0, -HALF_WIDTH, -1.0, -1.0, -_FLOAT32_PI), (LENGTH, HALF_WIDTH, 1.0, 1.0, _FLOAT32_PI)
OBSERVATION_LOW = (*_BODY_LOW, *_BODY_LOW, 0.0, -HALF_WIDTH, -3.0, -3.0, -1.0, -1.0, -_FLOAT32_GOAL)
OBSERVATION_HIGH = (*_BODY_HIGH, *_BODY_HIGH, LENGTH, HALF_WIDTH, 3.0, 3.0, 1.0, 1.0, 2.0 * _FLOAT32_GOAL)

# The shots of Hard Goal: intervals of the goal line, scaled to [-1, 1]. Each interval exists once for either foot.
STRETCHES = ((-1.0, -0.6), (-0.6, -0.2), (0.2, 0.2), (0.2, 0.6), (0.6, 1.0))
REPAIRED_MIDDLE = (-0.2, 0.2)

# Random numbers of an action: six per tick, and fewer than 400 ticks.
NUMBERS_PER_TICK = 6
_NUMBERS_PER_ACTION = 1 << 13
_GOING = -1  # in place of the outcome of an action that is not over


class GoalState(NamedTuple):
    """The state of N environments, columns `[N]`.

    Positions, velocities and orientations (radians) are float32, the counters int32. The player's orientation is not
    wrapped, so it may leave [-pi, pi].
    """

    player_x: Tensor
    player_y: Tensor
    keeper_x: Tensor
    keeper_y: Tensor
    ball_x: Tensor
    ball_y: Tensor
    player_vx: Tensor
    player_vy: Tensor
    keeper_vx: Tensor
    keeper_vy: Tensor
    ball_vx: Tensor
    ball_vy: Tensor
    player_angle: Tensor
    keeper_angle: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


COLUMNS = GoalState._fields[:14]  # what moves
