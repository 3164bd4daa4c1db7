"""Noise on exploring parameters, and schedules of what falls during training."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from hpamdp.settings import ScheduleShape


def with_exploring_noise(unit_actions: Tensor, deviation: float | Tensor) -> Tensor:
    """Return parameters in [-1, 1], of any shape, with Gaussian noise of this standard deviation."""
    return (unit_actions + deviation * torch.randn_like(unit_actions)).clamp(-1.0, 1.0)


def schedule(time: int, over: int, final: float, shape: ScheduleShape = "linear") -> float:
    """Return a fraction that falls from 1 to `final` within a time `over`, both in the same unit."""
    progress = schedule_progress(time / over if over > 0 else 1.0, shape)
    return 1.0 + (final - 1.0) * progress


def schedule_progress(time: float, shape: ScheduleShape) -> float:
    """Return how far a schedule has come, from 0 to 1, after a fraction `time` of its length; 0 if it is constant."""
    time = min(1.0, time)
    return {"linear": time, "cosine": 0.5 * (1.0 - math.cos(math.pi * time)), "constant": 0.0}[shape]
