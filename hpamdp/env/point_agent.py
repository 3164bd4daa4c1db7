"""A point agent in the plane and a fixed target: what Catch Point and Hard Move share. `point_kernel` has its rules.

Source: the code of Li et al. 2022 (HyAR), arXiv:2109.05490.
"""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

OBSERVATION_NAMES = ("vx", "vy", "target_dx", "target_dy")
VECTORS = ((0, 1), (2, 3))  # places of (x, y) pairs in the observation
HIT_RADIUS = 0.2
HIT_REWARD = 20.0
TOP_SPEED = 0.8  # length per unit of time at which full force and drag balance
_DRAG, _GAIN, _TICK = 0.75, 0.1, 0.1
# Without force, an agent glides this many times its speed until it rests.
GLIDE = _DRAG * _TICK / (1.0 - _DRAG)
# In the next step alone it glides this many times its speed.
NEXT_GLIDE = _DRAG * _TICK
# Distance by which one unit of force moves the point where the agent comes to rest.
REACH = _GAIN * _TICK / (1.0 - _DRAG)


class Located(Protocol):
    """Columns `[N]` that include the positions of the agents."""

    @property
    def x(self) -> Tensor:
        """The agents' x."""

    @property
    def y(self) -> Tensor:
        """The agents' y."""


class PointState(Located, Protocol):
    """Columns `[N]` that include the agents' positions and velocities, and the targets' positions."""

    @property
    def vx(self) -> Tensor:
        """The agents' velocity in x."""

    @property
    def vy(self) -> Tensor:
        """The agents' velocity in y."""

    @property
    def target_x(self) -> Tensor:
        """The targets' x."""

    @property
    def target_y(self) -> Tensor:
        """The targets' y."""


def observation_bounds(max_steps: int) -> tuple[list[float], list[float]]:
    """Return the lowest and the highest observation that this many steps can reach."""
    # The factor 1.001 allows for rounding.
    speed = 1.001 * TOP_SPEED
    offset = 2.0 + speed * _TICK * max_steps
    high = [speed, speed, offset, offset]
    return [-bound for bound in high], high


def rest_offset(state: PointState, glide: float) -> tuple[Tensor, Tensor]:
    """Return the x and y offset of the target from the point `glide` times the velocity ahead of the agent, `[N]` each.

    With GLIDE that is the point where the agent comes to rest, with NEXT_GLIDE its position after the next step.
    """
    return state.target_x - state.x - glide * state.vx, state.target_y - state.y - glide * state.vy
