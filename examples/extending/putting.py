"""Define a custom problem: put a ball into a hole with two clubs.

The ball lies some metres from the hole, on a line. The putter rolls it (one parameter: the power), the wedge chips it
further (two parameters: the power and the spin). The episode ends when the ball is holed, or after six strokes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from pydantic import NonNegativeFloat, PositiveInt
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.base import Metric
from hpamdp.env.batched_env import GOING_ON, SUCCESS, Action, BatchedEnv
from hpamdp.env.counter_rng import RngKey
from hpamdp.settings import Settings

PUTTER, WEDGE = range(2)
HOLE = 0.15  # m
FARTHEST = 20.0  # m, of a start
STROKE_COST, REWARD = 0.1, 1.0


class PuttingOptions(Settings):
    """Settings of `PuttingEnv`."""

    wind: NonNegativeFloat = 0.05
    """Standard deviation of a chip's length, as a fraction of the length."""
    max_steps: PositiveInt = 6
    """Strokes after which an episode is truncated."""


class Ball(NamedTuple):
    """Columns `[N]`: metres to the hole, then strokes so far, outcome and number of the episode (int32)."""

    distance: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


class PuttingEnv(BatchedEnv[Ball]):
    """Play `num_envs` balls at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 putter, 1 wedge; `("action", "parameters")` float32
    `[N, 3]`: the putter's power in [0, 1] (8 m), the wedge's power in [0, 1] (25 m) and its spin in [-1, 1] (1 m).
    Observation `[N, 2]`: distance to the hole in units of 20 m, and fraction of the strokes that remain. The reward is
    -0.1 for each stroke and 1 for holing the ball. For the constructor's arguments and errors see `BatchedEnv`.
    """

    Options = PuttingOptions
    options: PuttingOptions
    outcomes = ("playing", "holed", "time limit")
    observation_names = ("distance", "strokes_left")
    discrete_names = ("putter", "wedge")
    parameter_dims = (1, 2)
    parameter_low = (0.0, 0.0, -1.0)
    parameter_high = (1.0, 1.0, 1.0)

    def start(self, episode: Tensor, rng: RngKey) -> Ball:
        """Return balls that lie 1 to 20 m from the hole."""
        nothing = torch.zeros_like(episode)
        return Ball(1.0 + (FARTHEST - 1.0) * counter_rng.uniform(rng, 0), nothing, nothing, episode)

    def act(self, state: Ball, action: Action, rng: RngKey, is_idle: Tensor) -> tuple[Ball, Tensor]:
        """Return the balls after a stroke, and the rewards `[N]`."""
        power, spin = action.parameters.unbind(-1)
        gust = 1.0 + self.options.wind * counter_rng.normal(rng, state.steps)
        length = torch.where(action.discrete == PUTTER, 8.0 * power, 25.0 * power * gust + spin)
        left = (state.distance - length).abs()
        is_holed = left < HOLE
        outcome = torch.where(is_holed, SUCCESS, GOING_ON).int()
        return Ball(left, state.steps + 1, outcome, state.episode), REWARD * is_holed.float() - STROKE_COST

    def observe(self, state: Ball) -> Tensor:
        """Return the observations `[N, 2]`."""
        return torch.stack([state.distance / FARTHEST, 1.0 - state.steps.float() / self.max_steps], -1)

    # What an evaluation measures beside score and success.

    extra_names = ("left",)
    result_keys = (keys.OUTCOME, "left")
    table_metrics: ClassVar[tuple[Metric, ...]] = (*BatchedEnv.table_metrics, Metric("left", "metres left"))

    def extras(self, state: Ball) -> Sequence[Tensor]:
        """Return the distance to the hole in metres."""
        return (state.distance,)

    def extra_spec(self, name: str) -> TensorSpec:
        """Return the spec of the distance, which has no bound."""
        return Unbounded(shape=(self.num_envs, 1), device=self.device)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return whether the ball was holed and its distance to the hole, each `[M]`."""
        return {**super().results(last), "left": last.get("left").squeeze(-1)}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the mean remaining distance in metres."""
        return {"left": float(played["left"].mean())}
