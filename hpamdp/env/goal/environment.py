"""The Robot Soccer Goal domain and Hard Goal as batched TorchRL environments: beat a keeper and score.

Sources: Goal from Masson, Ranchod & Konidaris 2016, arXiv:1509.01644; Hard Goal from HyAR, Li et al. 2022,
arXiv:2109.05490; see `hpamdp.env.goal.rules`, also for the differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, get_args

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.env.base import Metric
from hpamdp.env.batched_env import KernelEnv
from hpamdp.env.goal import kernel, rendering, rules
from hpamdp.env.goal.options import ACTIONS, CARDS, HARD_GOAL_ACTIONS, GoalOptions, HardGoalOptions, HardSlip, Slip
from hpamdp.env.goal.rules import GoalState
from hpamdp.geometry import Symmetries, make_symmetries
from hpamdp.settings import Settings


class GoalEnv(KernelEnv[GoalState]):
    """Score against a keeper on `num_envs` half pitches at once.

    Action leaves:

    - `("action", "discrete")` int64 `[N]`: 0 kick to, 1 shoot left, 2 shoot right;
    - `("action", "parameters")` float32 `[N, 4]`: the point to kick to, x in [0, 40] and y in [-15, 15]. Then y in
      [-7.01, 7.01] for each shot, where it crosses the goal line.

    Only the parameters of the chosen action count. Outside their bounds they are clipped; NaN and infinity are refused.
    An action lasts for many ticks: a kick until the ball lies still within reach, a shot until the episode ends. The
    two shots are the same action.

    The reward is 50 for a goal. An episode ends otherwise if the keeper catches the ball, if the ball leaves the pitch,
    or at the time limit. Its last reward is then minus the distance of the ball from the goal.

    The rules are those behind all published numbers, with the slips of the published code; `options.repaired` takes
    slips out. Starts are always random. For the constructor's arguments and errors see `BatchedEnv`.
    """

    Options: ClassVar[type[Settings]] = GoalOptions
    card = CARDS["GoalEnv"]
    options: GoalOptions
    discrete_names: tuple[str, ...] = ACTIONS
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    observation_names = rules.OBSERVATION_NAMES
    parameter_dims: tuple[int, ...] = rules.PARAMETER_DIMS
    parameter_low: Sequence[float] = rules.PARAMETER_LOW
    parameter_high: Sequence[float] = rules.PARAMETER_HIGH
    slips: ClassVar[tuple[str, ...]] = get_args(Slip)
    row_kernel = staticmethod(kernel.advance)
    state_type = GoalState
    num_columns = (14, 3)
    table_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("success", "goals", "share"),
        Metric("return", "return"),
        Metric("caught", "caught", "share"),
        Metric("out", "out", "share"),
        Metric("time_limit", "time limit", "share"),
        Metric("steps", "steps an episode", "count"),
    )
    curve_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("success", "Episodes with a goal", "share"),
        Metric("return", "Return"),
    )

    def _prepare(self) -> None:
        self.limit_terminates = self.options.limit == "terminated"

    @property
    def _is_scaled(self) -> bool:
        return self.options.observation == "scaled"

    def kernel_settings(self) -> Sequence[float]:
        """Return the noise, the form of the observation, which slips are repaired, and which problem it is."""
        repaired = [slip in self.options.repaired for slip in get_args(HardSlip)]
        return [self.options.noise, self._is_scaled, *repaired, isinstance(self, HardGoalEnv)]

    def initial_parameters(self) -> tuple[Tensor, Tensor] | None:
        """Return the published initial parameters, scaled to [-1, 1], as a linear function of the observation.

        Kicks go to the ball's front, shots to one metre within each post. P-DQN and its relatives start from them;
        without them, learners take long to find a goal (Bester et al. 2019, arXiv:1905.04388).

        Returns:
            Weights `[4, 17]` and bias `[4]`; None if nothing is published.
        """
        weights = torch.zeros(
            len(rules.PARAMETER_LOW), len(rules.OBSERVATION_NAMES), device=self.device, dtype=torch.float32
        )
        place = {name: column for column, name in enumerate(rules.OBSERVATION_NAMES)}
        weights[0, place["ball_x"]] = 0.5
        weights[0, place["keeper_to_ball_x"]] = 0.0625
        weights[1, place["ball_y"]] = 5.0 / 6.0
        weights[1, place["keeper_to_ball_y"]] = 1.0 / 9.0
        bias = torch.tensor([-0.375, 0.0, 0.857346647646, -0.857346647646], device=self.device, dtype=torch.float32)
        if not self._is_scaled:
            low, high = bias.new_tensor(rules.OBSERVATION_LOW), bias.new_tensor(rules.OBSERVATION_HIGH)
            bias = bias - weights @ ((high + low) / (high - low))
            weights = 2.0 * weights / (high - low)
        return weights, bias

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return how episodes `[M]` ended: `success` (a goal), `caught`, `out` and `time_limit`, all bool.

        The `score` is 1 for a goal and 0 otherwise, as in all published comparisons.
        """
        outcome = last.get(keys.OUTCOME)
        success = outcome == rules.GOAL
        return {
            "success": success,
            "score": success.float(),
            "caught": outcome == rules.CAUGHT,
            "out": outcome == rules.OUT,
            "time_limit": outcome == rules.TIME_LIMIT,
        }

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the fractions of episodes that ended without a goal, by how they ended."""
        return {name: float(played[name].mean()) for name in ("caught", "out", "time_limit")}

    def draw(self, track: Sequence[GoalState]) -> np.ndarray:
        """Return a picture of the pitch and the way of the ball, uint8 `[480, 480, 3]`."""
        return rendering.draw(track)

    @property
    def symmetries(self) -> Symmetries | None:
        """The mirror y -> -y if all slips are repaired, otherwise None: each slip breaks the symmetry.

        An unrepaired kick goes to (x, x), on one side of the pitch. The distance from the goal is wrong on the other
        side alone. `keeper_projection` is clipped differently on the two sides.
        """
        if set(self.options.repaired) != set(self.slips):
            return None
        # y, vertical velocities and orientations change their sign.
        flips = torch.tensor([name.endswith(("_y", "_vy", "_angle", "_projection")) for name in self.observation_names])
        sign = torch.where(flips, -1.0, 1.0).float()
        offset = torch.zeros_like(sign)
        if self._is_scaled:
            low, high = (
                torch.tensor(rules.OBSERVATION_LOW, dtype=torch.float32),
                torch.tensor(rules.OBSERVATION_HIGH, dtype=torch.float32),
            )
            offset = torch.where(flips, -2.0 * (high + low) / (high - low), 0.0)
        discrete, parameters = self._mirrored_actions()
        return make_symmetries(
            torch.stack([torch.eye(len(sign), dtype=torch.float32), sign.diag()]),
            offset=torch.stack([torch.zeros_like(offset), offset]),
            discrete=torch.stack([torch.arange(len(self.parameter_dims)), discrete]),
            source=torch.stack([torch.arange(len(parameters)), parameters]),
            sign=torch.stack([torch.ones(len(parameters), dtype=torch.float32), self._mirrored_signs()]),
            num_parameters=len(parameters),
        )

    def _mirrored_actions(self) -> tuple[Tensor, Tensor]:
        """Return what each action becomes on the mirrored pitch, and which parameter takes each place."""
        return torch.arange(3), torch.arange(4)

    def _mirrored_signs(self) -> Tensor:
        """Return the signs that the parameters get: only x of a kick keeps its own."""
        return torch.tensor([1.0] + [-1.0] * (len(self.parameter_low) - 1), dtype=torch.float32)


class HardGoalEnv(GoalEnv):
    """Goal with eleven actions: a kick and ten shots, each at one stretch of the goal line.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 kick to, 1 to 5 shoot left, 6 to 10 shoot right, at the
    stretches from y = -7.01 to 7.01; `("action", "parameters")` float32 `[N, 12]` in [-1, 1]: the point to kick to,
    scaled from x in [0, 40] and y in [-15, 15], then one for each shot: its place in the stretch, 1 for the lower end.

    The published code does not clip the shots' parameters; within [-1, 1] that makes no difference.
    """

    Options = HardGoalOptions
    card = CARDS["HardGoalEnv"]
    discrete_names = HARD_GOAL_ACTIONS
    parameter_dims = (2,) + (1,) * (len(HARD_GOAL_ACTIONS) - 1)
    parameter_low = (-1.0,) * 12
    parameter_high = (1.0,) * 12
    slips = get_args(HardSlip)

    def initial_parameters(self) -> tuple[Tensor, Tensor] | None:
        """Return None: there are no published ones."""
        return None

    def _mirrored_actions(self) -> tuple[Tensor, Tensor]:
        # Each foot's five stretches change places, and with them their parameters.
        shots = torch.arange(1, 11).reshape(2, 5).flip(-1).flatten()
        return torch.cat([torch.zeros(1, dtype=torch.long), shots]), torch.cat([torch.arange(2), shots + 1])
