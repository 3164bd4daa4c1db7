"""The motions of Hard Move, the columns of its state, and its hand-written player. `kernel` has the rules.

Source: Li et al. 2022 (HyAR), arXiv:2109.05490, after Chandak et al. 2019, arXiv:1902.00183. The rules are those of
HyAR's code.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import point_agent
from hpamdp.env.hard_move.options import directions

OUTCOMES = ("going on", "reached", "time limit")
GOING_ON, REACHED, TIME_LIMIT = range(3)
_FORCE = 2.0


class HardMoveState(NamedTuple):
    """The state of N environments, columns `[N]`.

    It holds the agent's position and velocity, the target's position, and int32 counters.
    """

    x: Tensor
    y: Tensor
    vx: Tensor
    vy: Tensor
    target_x: Tensor
    target_y: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


def motions(n: int, *, rounded: bool) -> Tensor:
    """Return the motion of every set of actuators, float64 `[2^n, 2]`.

    Set k contains actuator i if bit n - 1 - i of k is set. The actuators' directions divide the full turn evenly. The
    motion of a set is the sum of its actuators' directions, divided by the length of the longest such sum.

    Args:
        n: number of actuators.
        rounded: whether the directions are rounded to three decimals, as published.
    """
    sets = torch.tensor(list(itertools.product((0.0, 1.0), repeat=n)), dtype=torch.float64)
    sums = sets @ torch.tensor(directions(n, rounded), dtype=torch.float64)
    return sums / sums.norm(dim=-1).max()


class Script:
    """A hand-written player. It chooses the push after which the agent would come to rest nearest to the target.

    Args:
        motions: motions of the sets, `[2^n, 2]`.
    """

    def __init__(self, motions: Tensor) -> None:
        # Many sets share a motion, and some have none. Keep the first set of each motion that is not 0.
        different, number = motions.round(decimals=6).unique(dim=0, return_inverse=True)
        first = torch.full((len(different),), len(motions), device=motions.device)
        sets = torch.arange(len(motions), device=motions.device)
        first = first.scatter_reduce(0, number, sets, "amin")
        self._sets = first[motions[first].norm(dim=-1) > 1e-3]
        self._reach = _FORCE * point_agent.REACH * motions[self._sets]

    def __call__(self, state: HardMoveState) -> tuple[Tensor, Tensor]:
        """Return the discrete action and the parameter, `[N]` each."""
        offset = torch.stack(point_agent.rest_offset(state, point_agent.GLIDE), -1)
        length = self._reach.norm(dim=-1)
        strength = ((offset @ self._reach.T) / length.square()).clamp(-1.0, 1.0)
        # The remaining squared distance, up to a constant: the squared length of the offset.
        left = strength * (strength * length.square() - 2.0 * (offset @ self._reach.T))
        best = left.argmin(-1)
        return self._sets[best], strength.gather(-1, best.unsqueeze(-1)).squeeze(-1)
