"""The boat-docking environment that was released with the benchmark's paper, whose rules differ from the paper's.

Source: the code released with *A Benchmark for Hierarchical Parameterized Action Markov Decision Process*. It is kept
to put the paper's table in context; `experiments/released` shows why returns here do not measure skill. It shares
nothing with `BoatDockEnv` but the framework's contract.
Differs from the source: many boats at once; layouts come from counters instead of NumPy's global generator; `scaled`
observations and a new layout for each episode are possible.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import torch
from pydantic import PositiveInt
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.actions import check_action_values
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.boatdock_released import rules as released
from hpamdp.env.boatdock_released.rules import ReleasedState
from hpamdp.env.facts import ProblemFacts
from hpamdp.env.state_columns import restored, where
from hpamdp.settings import Settings


class ReleasedBoatDockOptions(Settings):
    """Settings of `ReleasedBoatDockEnv`."""

    controller: Literal["congruent", "incongruent"] = "congruent"
    """Which boat it is. The agent cannot choose, so use high=none."""
    keymap: Literal[0, 1] = 0
    """Key map of the incongruent boat: 1, or 0, which is sampled from {0, 1} at every reset until it is 1.

    0 has the keys of key map 2 of env=boatdock. The congruent boat observes -1.
    """
    test_mode: Literal[0, 1, None] = None
    """1: only layouts whose bearing is within 30 degrees of the incongruent boat's directions; 0: only the others.

    If None, all layouts.
    """
    frozen_layouts: bool = True
    """Whether an environment keeps the layout of its first reset, as released, or has a new one every episode."""
    observation: Literal["pixels", "scaled"] = "pixels"
    """`pixels` `[N, 15]` as released, or `scaled` to about [-1, 1] with goal - boat appended, `[N, 17]`.

    If scaled, fuel is log(1 + fuel / 5).
    """
    max_steps: PositiveInt = 999
    """Steps after which an episode is truncated; released: 999."""


class ReleasedBoatDockEnv(PAMDPEnv):
    """Dock boats by the rules of the released code in `num_envs` environments at once.

    Action leaves: `("action", "discrete")` int64 `[N]`, the key, in {0, 1, 2}; `("action", "parameters")` float32
    `[N, 3]`, a duration u in [-1, 1] for each key. Only the pressed key's duration counts; outside its bounds it is
    clipped, NaN and infinity are refused. A press takes 2.5 (u + 1) seconds and u fuel, so u < 0 *re*fuels.

    Docking earns 10 x fuel / 5, an empty tank -1, the left and the upper wall and the time limit 0; any other press
    earns the decrease of the distance to the goal, as a share of the distance at the start. The step that ends an
    episode shows the boat and the distance from before it.

    An environment keeps its controller for life, so that no selector goes with it.

    Args:
        num_envs: number of boats.
        options: the settings; None for the defaults.
        dtype: `float32` or `float64`, of the computation and its results; durations are always rounded in float32.
        device: of the tensors.
        seed: of layouts and key maps; the global generators are neither read nor moved.
        first_env: number of the first boat, if other processes have those before it.
        settings: single settings by name, in place of those in `options`.

    `reset` also takes layouts to play, and keep: a tensordict with `start` and `goal` `[N, 2]` in screen px and, for
    the incongruent boat, optionally `keymap` int `[N]`.

    Raises:
        ValueError: an argument, action or layout is invalid; the state is unchanged.
    """

    Options = ReleasedBoatDockOptions
    parameter_dims = (1, 1, 1)
    result_keys = (keys.OUTCOME,)
    _state: ReleasedState

    def __init__(
        self,
        num_envs: int = 1,
        *,
        options: ReleasedBoatDockOptions | None = None,
        dtype: Literal["float32", "float64"] = "float32",
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
        **settings: Any,
    ) -> None:
        self.options = ReleasedBoatDockOptions.of(options, settings)
        if dtype not in ("float32", "float64"):
            raise ValueError(f"ReleasedBoatDockEnv: {dtype=}, but must be float32 or float64")
        if num_envs < 1:
            raise ValueError(f"ReleasedBoatDockEnv: {num_envs=}, but must be at least 1")
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs = num_envs
        self.max_steps = self.options.max_steps
        self.is_scaled = self.options.observation == "scaled"
        self.float_type: torch.dtype = getattr(torch, dtype)
        self._directions = torch.tensor(
            released.DIRECTIONS[self.options.controller], dtype=self.float_type, device=self.device
        )
        self._environment = torch.arange(first_env, first_env + num_envs, dtype=torch.int32, device=self.device)
        self._make_specs()
        self._set_seed(seed)

    @classmethod
    def facts(cls, options: Any) -> ProblemFacts:
        """Return what these settings tell of the problem."""
        return ProblemFacts(title=cls.__name__)

    def fixed_episodes(self, seed: int) -> TensorDict:
        """Return layouts to `reset` with, one for each boat, from another stream than those of training."""
        episode = torch.zeros_like(self._environment)
        seed_tensor = counter_rng.seed_tensor(seed, self.device)
        rng = counter_rng.rng_key(seed_tensor, counter_rng.EVALUATION, self._environment, episode)
        points = released.sample_layouts(rng, self.options.test_mode).to(self.float_type)
        layout = {"start": points[:, :2], "goal": points[:, 2:]}
        return TensorDict(layout, batch_size=self.batch_size, device=self.device)

    def describe(self) -> dict[str, Tensor]:
        """Return `start` and `goal` `[N, 2]` of the episodes, screen px."""
        points = torch.stack(self._state[:4], -1)
        return {"start": points[:, :2], "goal": points[:, 2:]}

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `outcome` and `success` `[M]`; the score is the return, as there is no measure of skill."""
        outcome = last.get(keys.OUTCOME)
        return {"outcome": outcome, "success": outcome == released.SUCCESS}

    def summary_entries(self) -> dict[str, str]:
        """Return which `controller` the boats have."""
        return {"controller": self.options.controller}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the shares of the outcomes other than success. There is no ceiling: idling refuels without limit."""
        return {
            released.OUTCOMES[code]: float((played["outcome"] == code).mean())
            for code in (released.WALL, released.OUT_OF_FUEL, released.TIME_LIMIT)
        }

    def env_state(self) -> dict[str, Tensor]:
        """Return the columns of the state, `[N]` each."""
        return self._state._asdict()

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Continue from an `env_state`; an empty one starts new episodes.

        Raises:
            ValueError: they are not the columns of a state of this many environments.
        """
        if not columns:
            self._reset()
            return
        self._state = restored(columns, self._state, "ReleasedBoatDockEnv")

    def _make_specs(self) -> None:
        n = self.num_envs
        device = self.device
        dtype = self.float_type
        names = released.SCALED_NAMES if self.is_scaled else released.OBSERVATION_NAMES
        self.observation_spec = Composite(
            observation=Unbounded(shape=(n, len(names)), device=device, dtype=dtype),
            outcome=Categorical(len(released.OUTCOMES), shape=(n,), device=device),
            shape=(n,),
        )
        bound = torch.ones(len(self.parameter_dims), dtype=torch.float32)
        self.action_spec = self.make_action_spec(-bound, bound)
        self.reward_spec = Unbounded(shape=(n, 1), device=device, dtype=dtype)
        self.done_spec = self.make_done_spec()

    def _set_seed(self, seed: int | None) -> None:
        self._seed = counter_rng.seed_tensor(0 if seed is None else seed, self.device)
        integer_zeros = torch.zeros_like(self._environment)
        zeros = integer_zeros.to(self.float_type)
        self._state = ReleasedState(
            start_x=zeros,
            start_y=zeros,
            goal_x=zeros,
            goal_y=zeros,
            x=zeros,
            y=zeros,
            velocity_x=zeros,
            velocity_y=zeros,
            fuel=zeros,
            keymap=integer_zeros
            + (self.options.keymap if self.options.controller == "incongruent" else released.NO_KEYMAP),
            steps=integer_zeros,
            outcome=integer_zeros,
            episode=integer_zeros - 1,
        )

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = self.reset_mask(tensordict)
        given = {} if tensordict is None else self._given_layout(tensordict)
        before = self._state
        episode = before.episode + 1
        rng = counter_rng.rng_key(self._seed, counter_rng.TRAINING, self._environment, episode)
        layout = given or self._sampled_layout(rng, mask)
        if "keymap" in layout:
            keymap = layout["keymap"]
        else:
            sampled = (counter_rng.uniform(rng, released.INDEX_KEYMAP) < 0.5).to(torch.int32)
            keymap = torch.where(before.keymap == 0, sampled, before.keymap)
        fresh = before._replace(**layout)
        fresh = fresh._replace(
            x=fresh.start_x,
            y=fresh.start_y,
            # As released, the velocity stays that of the previous episode's last press.
            fuel=torch.full_like(before.fuel, released.TANK),
            keymap=keymap,
            steps=torch.zeros_like(before.steps),
            outcome=torch.full_like(before.outcome, released.SAILING),
            episode=episode,
        )
        self._state = where(mask, fresh, before)
        return self._read()

    def _sampled_layout(self, rng: counter_rng.RngKey, mask: Tensor) -> dict[str, Tensor]:
        """Return the layout columns of the state, with new layouts in those rows of `mask` `[N]` that need one."""
        is_due = mask & (self._state.episode < 0) if self.options.frozen_layouts else mask
        state = self._state
        points = torch.stack([state.start_x, state.start_y, state.goal_x, state.goal_y], -1)
        if is_due.any():
            points[is_due] = released.sample_layouts(rng._replace(bits=rng.bits[is_due]), self.options.test_mode).to(
                points
            )
        start_x, start_y, goal_x, goal_y = points.unbind(-1)
        return {"start_x": start_x, "start_y": start_y, "goal_x": goal_x, "goal_y": goal_y}

    def _given_layout(self, given: TensorDictBase) -> dict[str, Tensor]:
        """Check a user's layout and return the columns of the state that it sets; empty without a layout."""
        if not {"start", "goal", "keymap"} & set(given.keys()):
            return {}
        low = torch.tensor(released.LOW, device=self.device, dtype=torch.float32)
        points = {}
        for name in ("start", "goal"):
            point = given.get(name, None)
            if point is None or point.shape != (self.num_envs, 2):
                shape = None if point is None else list(point.shape)
                raise ValueError(f"reset: {name} has shape {shape}, but must be [{self.num_envs}, 2] (screen px)")
            points[name] = point.to(self.device, self.float_type)
            if not ((points[name] >= low) & (points[name] < low + released.SIZE)).all():
                bounds = [f"[{corner}, {corner + released.SIZE}]" for corner in released.LOW]
                raise ValueError(f"reset: a {name} lies outside x in {bounds[0]}, y in {bounds[1]} (screen px)")
        if not ((points["start"] - points["goal"]).norm(dim=-1) >= 1.0).all():
            raise ValueError("reset: a start lies within 1 px of its goal")
        start_x, start_y = points["start"].unbind(-1)
        goal_x, goal_y = points["goal"].unbind(-1)
        columns = {"start_x": start_x, "start_y": start_y, "goal_x": goal_x, "goal_y": goal_y}
        keymap = given.get("keymap", None)
        if keymap is None:
            return columns
        if self.options.controller == "congruent":
            raise ValueError("reset: keymap is given, but the congruent boat has none")
        if keymap.shape != (self.num_envs,) or not ((keymap == 0) | (keymap == 1)).all():
            raise ValueError(f"reset: keymap must be 0 or 1 in shape [{self.num_envs}]")
        return {**columns, "keymap": keymap.to(self.device, torch.int32)}

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.check_action(tensordict)
        key = tensordict.get(keys.DISCRETE)
        durations = tensordict.get(keys.PARAMETERS)
        check_action_values(key, durations, self.parameter_dims, names=("key", "durations"))
        key = key.long()
        duration = durations.gather(-1, key.unsqueeze(-1)).squeeze(-1).to(torch.float32).clamp(-1.0, 1.0)
        before = self._state
        is_over = before.outcome != released.SAILING
        mask = tensordict.get("_step", None)
        if mask is not None:
            is_over = is_over | ~mask.reshape(self.num_envs)
        direction = self._directions[before.keymap.clamp(min=0).long(), key]
        after, reward = released.press(before, direction, duration, self.max_steps)
        self._state = where(is_over, before, after)
        return self._read().set(keys.REWARD, torch.where(is_over, 0.0, reward).unsqueeze(-1))

    def _read(self) -> TensorDict:
        outcome = self._state.outcome.long()
        done = (outcome != released.SAILING).unsqueeze(-1)
        truncated = (outcome == released.TIME_LIMIT).unsqueeze(-1)
        leaves = {
            keys.OBSERVATION: released.observe(self._state, self.options.controller == "congruent", self.is_scaled),
            keys.OUTCOME: outcome,
            keys.DONE: done,
            keys.TERMINATED: done & ~truncated,
            keys.TRUNCATED: truncated,
        }
        return TensorDict(leaves, batch_size=self.batch_size, device=self.device)
