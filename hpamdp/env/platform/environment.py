"""The Platform domain as a batched TorchRL environment: over two gaps and two enemies to the end of a course.

Source: Masson, Ranchod & Konidaris 2016, arXiv:1509.01644; see `hpamdp.env.platform.rules`, also for the differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from hpamdp.env.batched_env import KernelEnv
from hpamdp.env.platform import rendering, rules
from hpamdp.env.platform.options import CARDS, PlatformOptions
from hpamdp.env.platform.rules import PlatformState


class PlatformEnv(KernelEnv[PlatformState]):
    """Cross the platforms in `num_envs` courses at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 run, 1 hop, 2 leap; `("action", "parameters")` float32
    `[N, 3]`: the power of a run in [0, 30] px/s a tick, the distance of a hop in [0, 720] px, and that of a leap in
    [0, 430] px. Only the parameter of the chosen action counts; outside its bounds it is clipped, NaN and infinity are
    refused. A run takes a second, a jump lasts until the agent lands.

    The reward is the distance covered as a fraction of the course, so an agent that arrives has the return 1. An
    episode terminates at the end of the course, in a gap or at an enemy.

    Only the noise is random. For the constructor's arguments and errors see `BatchedEnv`.
    """

    Options = PlatformOptions
    card = CARDS["PlatformEnv"]
    options: PlatformOptions
    discrete_names = rules.ACTIONS
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    observation_names = rules.OBSERVATION_NAMES
    parameter_dims = (1, 1, 1)
    parameter_low = (0.0, 0.0, 0.0)
    parameter_high = rules.PARAMETER_HIGH
    row_kernel = staticmethod(rules.advance)
    state_type = PlatformState
    num_columns = (4, 3)
    film_shape = (3.0, 0.5)

    def kernel_settings(self) -> Sequence[float]:
        """Return the factor on the noise."""
        return [self.options.noise]

    def initial_parameters(self) -> tuple[Tensor, Tensor]:
        """Return constants, scaled to [-1, 1]: run 3, hop 10, leap 400, as weights 0 `[3, 9]` and a bias `[3]`."""
        bias = (
            2.0
            * torch.tensor(rules.INITIAL_PARAMETERS, dtype=torch.float32)
            / torch.tensor(rules.PARAMETER_HIGH, dtype=torch.float32)
            - 1.0
        )
        return torch.zeros(len(bias), len(rules.OBSERVATION_NAMES), dtype=torch.float32), bias

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]]:
        """The lowest and the highest observation, `[9]` each."""
        return [-1.0] * len(self.observation_names), [1.0] * len(self.observation_names)

    def draw(self, track: Sequence[PlatformState]) -> np.ndarray:
        """Return a picture of the course, uint8 `[240, 1440, 3]`."""
        return rendering.draw(track)

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the best possible return as `ceiling`."""
        return {"ceiling": 1.0}
