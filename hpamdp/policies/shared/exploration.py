"""How replay learners explore: noise on the parameters, and random actions in the place of some."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from pydantic import NonNegativeFloat, NonNegativeInt
from torch import Tensor

from hpamdp.settings import Fraction, OwnSteps, Settings


class ParameterNoiseOptions(Settings):
    """Exploration by noise on the parameters."""

    parameter_noise: NonNegativeFloat = 0.1
    """Standard deviation of the exploring noise on the parameters, in units where their bounds are [-1, 1]."""


class EpsilonOptions(ParameterNoiseOptions):
    """Exploration by noise on the parameters and by random actions."""

    epsilon_final: Annotated[Fraction, OwnSteps()] = 0.05
    """Probability of a random action after `epsilon_steps`; it falls linearly from 1 to this value."""
    epsilon_steps: Annotated[NonNegativeInt, OwnSteps()] = 40_000
    """The learner's own steps, after its warm-up, within which the probability of a random action falls."""


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
