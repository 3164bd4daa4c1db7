"""How replay learners explore: noise on the parameters, and random actions in the place of some."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def with_exploring_noise(unit_actions: Tensor, deviation: float | Tensor) -> Tensor:
    """Return parameters in [-1, 1], of any shape, with Gaussian noise of this standard deviation."""
    return (unit_actions + deviation * torch.randn_like(unit_actions)).clamp(-1.0, 1.0)


def linear_schedule(time: int, over: int, final: float) -> float:
    """Return a fraction that falls linearly from 1 to `final` within a time `over`, both in the same unit.

    If `over` is 0, it has fallen at once.
    """
    return 1.0 + (final - 1.0) * (min(1.0, time / over) if over > 0 else 1.0)


def cosine_schedule(time: int, over: int) -> float:
    """Return a fraction that falls from 1 to 0 along half a cosine within a time `over`, both in the same unit."""
    return 0.5 * (1.0 + math.cos(math.pi * min(1.0, time / max(1, over))))
