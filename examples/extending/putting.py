"""Define a custom problem: put a ball into a hole with two clubs.

The ball lies some metres from the hole, on a line. The putter rolls it (one parameter: the power), the wedge chips it
further (two parameters: the power and the spin). The episode ends when the ball is holed, or after six strokes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from pydantic import NonNegativeFloat
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.base import Metric, PAMDPEnv
from hpamdp.env.state_columns import where

PUTTER, WEDGE = range(2)
HOLE = 0.15  # m
FARTHEST = 20.0  # m, of a start
STROKE_COST, REWARD = 0.1, 1.0


class Ball(NamedTuple):
    """Columns `[N]`: metres to the hole (negative beyond it), strokes so far, and number of the episode."""

    distance: Tensor
    strokes: Tensor
    episode: Tensor


class PuttingEnv(PAMDPEnv):
    """Play `num_envs` balls at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 putter, 1 wedge; `("action", "parameters")` float32
    `[N, 3]`: the putter's power in [0, 1] (8 m), the wedge's power in [0, 1] (25 m) and its spin in [-1, 1] (1 m).
    Observation `[N, 2]`: distance to the hole in units of 20 m, and fraction of the strokes that remain. The reward is
    -0.1 for each stroke and 1 for holing the ball.

    Args:
        num_envs: number of balls.
        wind: standard deviation of a chip's length, as a fraction of the length.
        device: device of the tensors.
        seed: seed of the starts and the wind.
        first_env: number of the first ball, if other processes have earlier balls.
    """

    parameter_dims = (1, 2)
    max_steps = 6
    table_metrics: ClassVar[tuple[Metric, ...]] = (*PAMDPEnv.table_metrics, Metric("left", "metres left"))

    def __init__(
        self,
        num_envs: int = 1,
        *,
        wind: NonNegativeFloat = 0.05,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
    ) -> None:
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs = num_envs
        self.wind = wind
        self._number = torch.arange(first_env, first_env + num_envs, dtype=torch.int32, device=self.device)
        self.observation_spec = Composite(
            observation=Unbounded(shape=(num_envs, 2), device=self.device),
            left=Unbounded(shape=(num_envs,), device=self.device),
            shape=(num_envs,),
        )
        self.action_spec = self.make_action_spec(torch.tensor([0.0, 0.0, -1.0]), torch.ones(3))
        self.reward_spec = Unbounded(shape=(num_envs, 1), device=self.device)
        self.done_spec = self.make_done_spec()
        self._set_seed(seed)

    # The framework's contract beyond TorchRL's: results of episodes, and figures to show.

    result_keys = ("left",)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return whether the ball was holed and its distance to the hole, each `[M]`."""
        left = last.get("left")
        return {"success": left < HOLE, "left": left}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the mean remaining distance in metres."""
        return {"left": float(played["left"].mean())}

    def env_state(self) -> dict[str, Tensor]:
        """Return the balls' columns, so that a run can be resumed exactly."""
        return self._ball._asdict()

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Continue from an `env_state`."""
        self._ball = Ball(**columns)

    # TorchRL's contract.

    def _set_seed(self, seed: int | None) -> None:
        self._seed = counter_rng.seed_tensor(seed or 0, self.device)
        nothing = torch.zeros_like(self._number)
        self._ball = Ball(nothing.float(), nothing, nothing - 1)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        episode = self._ball.episode + 1
        chance = counter_rng.rng_key(self._seed, counter_rng.TRAINING, self._number, episode)
        distance = 1.0 + (FARTHEST - 1.0) * counter_rng.uniform(chance, 0)
        fresh = Ball(distance, torch.zeros_like(episode), episode)
        self._ball = where(self.reset_mask(tensordict), fresh, self._ball)
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.check_action(tensordict)
        ball = self._ball
        is_over = (ball.distance.abs() < HOLE) | (ball.strokes >= self.max_steps)
        power, chip, spin = tensordict.get(keys.PARAMETERS).clamp(-1.0, 1.0).unbind(-1)
        chance = counter_rng.rng_key(self._seed, counter_rng.NOISE, self._number, ball.episode)
        gust = 1.0 + self.wind * counter_rng.normal(chance, ball.strokes)
        is_putt = tensordict.get(keys.DISCRETE) == PUTTER
        length = torch.where(is_putt, 8.0 * power.clamp(min=0.0), 25.0 * chip.clamp(min=0.0) * gust + spin)
        left = ball.distance.abs() - length
        self._ball = where(is_over, ball, Ball(left, ball.strokes + 1, ball.episode))
        is_holed = (self._ball.distance.abs() < HOLE) & ~is_over
        reward = torch.where(is_over, 0.0, REWARD * is_holed.float() - STROKE_COST)
        return self._read().set(keys.REWARD, reward.unsqueeze(-1))

    def _read(self) -> TensorDict:
        left = self._ball.distance.abs()
        remaining = 1.0 - self._ball.strokes / self.max_steps
        terminated = (left < HOLE).unsqueeze(-1)
        truncated = (self._ball.strokes >= self.max_steps).unsqueeze(-1) & ~terminated
        leaves = {
            keys.OBSERVATION: torch.stack([left / FARTHEST, remaining], -1),
            "left": left,
            keys.TERMINATED: terminated,
            keys.TRUNCATED: truncated,
            keys.DONE: terminated | truncated,
        }
        return TensorDict(leaves, batch_size=self.batch_size, device=self.device)
