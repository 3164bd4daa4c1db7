"""The constants of Catch Point, the columns of its state, and its hand-written player. `kernel` has the rules.

Source: Fan et al. 2019, arXiv:1903.01344; constants and rules as in the code of Li et al. 2022 (HyAR),
arXiv:2109.05490.
Differs from the source: a catch at a distance of exactly 0 succeeds. In the source it loses.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import point_agent

MOVE, CATCH = range(2)
ACTIONS = ("move", "catch")
OUTCOMES = ("going on", "caught", "no catches left", "time limit")
GOING_ON, CAUGHT, NO_CATCHES_LEFT, TIME_LIMIT = range(4)
PROGRESS_NAMES = ("misses", "time")
_FORCE = 2.0


class CatchPointState(NamedTuple):
    """The state of N environments, columns `[N]`.

    It holds the agent's position and velocity, the target's position, and int32 counters. `misses` counts failed
    catches.
    """

    x: Tensor
    y: Tensor
    vx: Tensor
    vy: Tensor
    target_x: Tensor
    target_y: Tensor
    misses: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


def scripted_action(state: CatchPointState) -> tuple[Tensor, Tensor]:
    """Return the discrete action and the parameter of a hand-written player, `[N]` each.

    It catches if the catch will succeed. Otherwise it pushes, in the direction from where the agent would come to rest
    to the target.
    """
    miss_x, miss_y = point_agent.rest_offset(state, point_agent.NEXT_GLIDE)
    can_hit = miss_x.square() + miss_y.square() <= point_agent.HIT_RADIUS * point_agent.HIT_RADIUS
    to_x, to_y = point_agent.rest_offset(state, point_agent.GLIDE)
    return torch.where(can_hit, CATCH, MOVE), torch.atan2(to_x, to_y) / math.pi
