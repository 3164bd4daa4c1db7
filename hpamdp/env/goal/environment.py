"""The Robot Soccer Goal domain and Hard Goal as batched TorchRL environments: beat a keeper and score.

Sources: Goal from Masson, Ranchod & Konidaris 2016, arXiv:1509.01644; Hard Goal from HyAR, Li et al. 2022,
arXiv:2109.05490; see `hpamdp.env.goal.rules`, also for the differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.env.base import Metric
from hpamdp.env.counter_env import CounterEnv
from hpamdp.env.counter_rng import Key
from hpamdp.env.goal import kernel, rendering, rules
from hpamdp.env.goal.rules import Aim, GoalState
from hpamdp.geometry import Symmetries, make_symmetries

Slip = Literal["kick_to", "goal_distance", "keeper_projection", "middle_shots"]  # the last is Hard Goal's alone


class GoalEnv(CounterEnv[GoalState]):
    """Score against a keeper on `num_envs` half pitches at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 kick to, 1 shoot left, 2 shoot right;
    `("action", "parameters")` float32 `[N, 4]`: the point to kick to, x in [0, 40] and y in [-15, 15], then for each
    shot where it crosses the goal line, y in [-7.01, 7.01]. Only the parameters of the chosen action count; outside
    their bounds they are clipped, NaN and infinity are refused. An action lasts for many ticks: a kick until the ball
    lies still within reach, a shot until the episode ends. The two shots are the same action.

    The reward is 50 for a goal. An episode that ends otherwise, since the keeper catches the ball or the ball leaves
    the pitch, or at the time limit, costs the distance of the ball from the goal.

    The rules are those behind all published numbers. That includes slips of the published code, which `repaired` takes
    out:
    - `kick_to`: a kick to (x, y) goes to (x, x), so that y is never read;
    - `goal_distance`: behind the goal line below the goal, it is twice 7.01 too large;
    - `keeper_projection`: this observation is clipped to [-7.01, 14.02] instead of [-7.01, 7.01].

    Args:
        num_envs: number of pitches.
        max_steps: actions after which an episode is truncated. The last one is not played, as in gym-goal, which has
            100.
        observation: `scaled` to [-1, 1], which orientations and the ball can leave, or `raw`; `[N, 17]` both.
        noise: factor on the published noise of the motions; 0 is none. Starts are random all the same. At most 5: from
            about 10 on, a run towards -x gets nowhere on average, and an action may never end.
        repaired: the slips to take out; `slips` are those that the problem has.
        compile_rules: compile the ticks (takes about a minute) instead of using the kernel, for a GPU.
        device: of the tensors.
        seed: of starts and noise; the global generators are neither read nor moved.
        first_env: number of the first pitch, where other processes have the pitches before it.

    Raises:
        ValueError: an argument or an action is invalid; the state is unchanged.
    """

    discrete_names: tuple[str, ...] = rules.ACTIONS
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    observation_names = rules.OBSERVATION_NAMES
    parameter_dims: tuple[int, ...] = rules.PARAMETER_DIMS
    parameter_low: ClassVar[tuple[float, ...]] = rules.PARAMETER_LOW
    parameter_high: ClassVar[tuple[float, ...]] = rules.PARAMETER_HIGH
    slips: ClassVar[tuple[str, ...]] = ("kick_to", "goal_distance", "keeper_projection")
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

    def __init__(
        self,
        num_envs: int = 1,
        *,
        max_steps: int = 100,
        observation: Literal["scaled", "raw"] = "scaled",
        noise: float = 1.0,
        repaired: Sequence[Slip] = (),
        compile_rules: bool = False,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
    ) -> None:
        self._check_arguments(observation, noise, repaired)
        super().__init__(
            num_envs,
            max_steps=max_steps,
            parameter_low=self.parameter_low,
            parameter_high=self.parameter_high,
            device=device,
            seed=seed,
            first_env=first_env,
        )
        self.noise = noise
        self.repaired = tuple(repaired)
        self._is_scaled = observation == "scaled"
        self._tick, self._random_numbers = rules.masked_tick, rules.random_numbers
        if compile_rules:
            self._tick = torch.compile(rules.masked_tick, **rules.COMPILE_ARGUMENTS)
            self._random_numbers = torch.compile(rules.random_numbers, **rules.COMPILE_ARGUMENTS)
        self._is_compiled = compile_rules
        repairs = ("kick_to", "goal_distance", "keeper_projection", "middle_shots")
        is_hard = self.parameter_dims != rules.PARAMETER_DIMS
        self._use_kernel(
            kernel.advance,
            GoalEnv,
            [noise, self._is_scaled, *(repair in self.repaired for repair in repairs), is_hard],
        )

    def start(self, episode: Tensor, rng: Key) -> GoalState:
        """Return the states in which episodes begin."""
        return rules.start(episode, rng)

    def act(
        self, state: GoalState, discrete: Tensor, parameters: Tensor, rng: Key, is_idle: Tensor
    ) -> tuple[GoalState, Tensor]:
        """Return the states after one action, and the rewards `[N]`."""

        def numbers(ticks: Tensor, rows: Tensor) -> Tensor:
            return self._random_numbers(rng._replace(bits=rng.bits[rows]), state.steps[rows], ticks)

        after, _ = rules.act(
            state,
            self._aim(discrete, parameters),
            ~is_idle,
            numbers,
            noise=self.noise,
            max_steps=self.max_steps,
            tick=self._tick,
        )
        return after, rules.reward(state, after, repairs_distance="goal_distance" in self.repaired)

    def observe(self, state: GoalState) -> Tensor:
        """Return the observations `[N, 17]`."""
        return rules.observe(state, is_scaled=self._is_scaled, repairs_projection="keeper_projection" in self.repaired)

    def initial_parameters(self) -> tuple[Tensor, Tensor] | None:
        """Return the published initial parameters, scaled to [-1, 1], as a linear function of the observation.

        Kicks go to the ball's front, shots to one metre within each post. P-DQN and its relatives start from them;
        where they are missing, learners take long to find a goal (Bester et al. 2019, arXiv:1905.04388).

        Returns:
            Weights `[4, 17]` and bias `[4]`; None where nothing is published.
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

    @property
    def default_options(self) -> Mapping[str, Sequence[int | str]]:
        """Carry: the kick to a point; shoot: all shots."""
        return {"carry": self.discrete_names[:1], "shoot": self.discrete_names[1:]}

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
        """Return the shares of episodes that ended in each way but by a goal."""
        return {name: float(played[name].mean()) for name in ("caught", "out", "time_limit")}

    def draw(self, track: Sequence[GoalState]) -> np.ndarray:
        """Return a picture of the pitch and the way of the ball, uint8 `[480, 480, 3]`."""
        return rendering.draw(track)

    @property
    def symmetries(self) -> Symmetries | None:
        """The mirror y -> -y, with all slips repaired; each of them breaks it, so that else there is none.

        An unrepaired kick goes to (x, x), on one side of the pitch; the distance from the goal is wrong on the other
        side alone, and the keeper's shadow is clipped differently on the two sides.
        """
        if set(self.repaired) != set(self.slips):
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

    def _aim(self, discrete: Tensor, parameters: Tensor) -> Aim:
        return rules.goal_aim(discrete, parameters, kicks_to_point="kick_to" in self.repaired)

    def _check_arguments(self, observation: str, noise: float, repaired: Sequence[str]) -> None:
        name = type(self).__name__
        if observation not in ("scaled", "raw"):
            raise ValueError(f"{name}: observation={observation!r}, but must be scaled or raw")
        if not 0.0 <= noise <= 5.0:
            raise ValueError(f"{name}: noise={noise}, but must lie between 0 and 5")
        unknown = [slip for slip in repaired if slip not in self.slips]
        if unknown:
            raise ValueError(f"{name}: repaired={list(repaired)}, but may only have {', '.join(self.slips)}")


class HardGoalEnv(GoalEnv):
    """Goal with eleven actions: a kick and ten shots, each at one stretch of the goal line.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 kick to, 1 to 5 shoot left, 6 to 10 shoot right, at the
    stretches from y = -7.01 to 7.01; `("action", "parameters")` float32 `[N, 12]` in [-1, 1]: the point to kick to,
    scaled from x in [0, 40] and y in [-15, 15], then one of each shot: where in its stretch, 1 being the lower end.

    A further slip of the published code, beside those of `GoalEnv`, is `middle_shots`: the middle stretch is a single
    point, y = 1.402, and not [-1.402, 1.402], so that no shot goes to the middle of the goal.

    The published code does not clip the shots' parameters; within [-1, 1] that makes no difference.

    For the arguments and errors see `GoalEnv`.
    """

    discrete_names = rules.HARD_GOAL_ACTIONS
    parameter_dims = (2,) + (1,) * (len(rules.HARD_GOAL_ACTIONS) - 1)
    parameter_low = (-1.0,) * 12
    parameter_high = (1.0,) * 12
    slips = ("kick_to", "goal_distance", "keeper_projection", "middle_shots")

    def initial_parameters(self) -> tuple[Tensor, Tensor] | None:
        """Return None: there are no published ones."""
        return None

    def _mirrored_actions(self) -> tuple[Tensor, Tensor]:
        # Each foot's five stretches change places, and with them their parameters.
        shots = torch.arange(1, 11).reshape(2, 5).flip(-1).flatten()
        return torch.cat([torch.zeros(1, dtype=torch.long), shots]), torch.cat([torch.arange(2), shots + 1])

    def _aim(self, discrete: Tensor, parameters: Tensor) -> Aim:
        return rules.hard_goal_aim(
            discrete,
            parameters,
            kicks_to_point="kick_to" in self.repaired,
            has_middle="middle_shots" in self.repaired,
        )
