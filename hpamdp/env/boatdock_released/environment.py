"""The boat-docking environment that was released with the benchmark's paper, rule for rule: not the task it describes.

Source: the code released with *A Benchmark for Hierarchical Parameterized Action Markov Decision Process*. Kept so that
the paper's table can be put in context; `experiments/released` shows why returns here are no measure of skill. Shares
nothing with `BoatDockEnv` but the framework's contract.
Differs from the source: many boats at once; layouts come from counters instead of NumPy's global generator; `scaled`
observations and new layouts for each episode can be had.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.boatdock_released import rules as released
from hpamdp.env.columns import taken_back, where


class ReleasedBoatDockEnv(PAMDPEnv):
    """Dock boats by the rules of the released code in `num_envs` environments at once.

    Action leaves: `("action", "discrete")` int64 `[N]` in {0, 1, 2}; `("action", "parameters")` float32 `[N, 3]`, one u in
    [-1, 1] for each key, of which only the pressed key's counts (values outside are clipped, NaN and infinite ones
    refused). A press takes 2.5 (u + 1) seconds and u fuel, so u < 0 *re*fuels. A goal reached earns 10 x fuel / 5, an
    empty tank -1, the left and the upper wall and the time limit 0; other moves what they take off the distance to the
    goal, as a share of the distance at the start. The step that ends an episode shows boat and distance as before it.

    Args:
        num_envs: how many boats.
        controller: `congruent` or `incongruent`. No selector goes with this environment: once an environment has its
            controller, it keeps it for life.
        keymap: of the incongruent boat: 1, or 0, which counts as unset and is drawn from {0, 1} at every reset until
            it is 1 (0 presses as key map 2 of `BoatDockEnv`). The congruent boat's reads -1.
        test_mode: 1: only layouts whose bearing from start to goal is within 30 degrees of (0, 1) or (-+.87, -.5), the
            incongruent boat's directions; 0: only others; None: all.
        frozen_layouts: an environment keeps the layout of its first reset, as released; otherwise every episode has its
            own. `set_seed` makes a new environment of each, with a layout of its own.
        observation: `pixels`, as released (`[N, 15]`), or `scaled` to about [-1, 1] with goal - boat appended
            (`[N, 17]`), where fuel is log(1 + fuel / 5).
        max_steps: steps after which an episode is truncated; released are 999.
        dtype: `float32` or `float64`, of what is computed and given; durations are rounded in float32 always.
        device: where the boats live.
        seed: of layouts and key maps; the global generators are neither read nor moved.
        first_env: number of the first boat, where other processes have those before.

    `reset` also takes layouts to play, and keep: a tensordict with `start` and `goal` `[N, 2]` in screen px and, for
    the incongruent boat, optionally `keymap` int `[N]`.

    Raises:
        ValueError: an argument, action or layout that is out of range; the boats are left as they were.
    """

    parameter_dims = (1, 1, 1)
    result_keys: ClassVar[tuple[str, ...]] = (keys.OUTCOME,)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        controller: Literal["congruent", "incongruent"] = "congruent",
        keymap: Literal[0, 1] = 0,
        test_mode: Literal[0, 1, None] = None,
        frozen_layouts: bool = True,
        observation: Literal["pixels", "scaled"] = "pixels",
        max_steps: int = 999,
        dtype: Literal["float32", "float64"] = "float32",
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
    ) -> None:
        for name, value, allowed in (
            ("controller", controller, tuple(released.DIRECTIONS)),
            ("keymap", keymap, (0, 1)),
            ("test_mode", test_mode, (None, 0, 1)),
            ("observation", observation, ("pixels", "scaled")),
            ("dtype", dtype, ("float32", "float64")),
        ):
            if value not in allowed:
                raise ValueError(
                    f"ReleasedBoatDockEnv: {name}={value!r}, but must be one of {', '.join(map(str, allowed))}"
                )
        for name, value in (("num_envs", num_envs), ("max_steps", max_steps)):
            if value < 1:
                raise ValueError(f"ReleasedBoatDockEnv: {name}={value}, but must be at least 1")
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs, self.max_steps, self.float_type = num_envs, max_steps, getattr(torch, dtype)
        self.controller, self.keymap, self.test_mode = controller, keymap, test_mode
        self.frozen_layouts, self.is_scaled = frozen_layouts, observation == "scaled"
        self._directions = torch.tensor(released.DIRECTIONS[controller], dtype=self.float_type, device=self.device)
        self._environment = torch.arange(first_env, first_env + num_envs, dtype=torch.int32, device=self.device)
        self._make_specs()
        self._set_seed(seed)

    def fixed_episodes(self, seed: int) -> TensorDict:
        """Return layouts to `reset` with, one for each boat, from a stream that training doesn't draw from."""
        stream, first = counter_rng.EVALUATION, torch.zeros_like(self._environment)
        rng = counter_rng.key_for(counter_rng.seed_tensor(seed, self.device), stream, self._environment, first)
        points = released.draw_layouts(rng, self.test_mode).to(self.float_type)
        layout = {"start": points[:, :2], "goal": points[:, 2:]}
        return TensorDict(layout, batch_size=self.batch_size, device=self.device)

    def describe(self) -> dict[str, Tensor]:
        """Return `start` and `goal` `[N, 2]` of the episodes, screen px."""
        points = torch.stack(self._state[:4], -1)
        return {"start": points[:, :2], "goal": points[:, 2:]}

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `outcome` and `success` `[M]`; the score is the return, for want of a measure of skill."""
        outcome = last.get(keys.OUTCOME)
        return {"outcome": outcome, "success": outcome == released.SUCCESS}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the shares of the outcomes beside success. There is no ceiling: idling refuels without limit."""
        return {
            released.OUTCOMES[code]: float((played["outcome"] == code).mean())
            for code in (released.WALL, released.OUT_OF_FUEL, released.TIME_LIMIT)
        }

    def env_state(self) -> dict[str, Tensor]:
        """Return the columns of the state, `[N]` each."""
        return self._state._asdict()

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Go on where `state_columns` were taken; with none, episodes start anew.

        Raises:
            ValueError: they are not the columns of a state of this many environments.
        """
        if not columns:
            self._reset()
            return
        self._state = taken_back(columns, self._state, "ReleasedBoatDockEnv")

    def _make_specs(self) -> None:
        n, device, dtype = self.num_envs, self.device, self.float_type
        names = released.SCALED_NAMES if self.is_scaled else released.OBSERVATION_NAMES
        self.observation_spec = Composite(
            observation=Unbounded(shape=(n, len(names)), device=device, dtype=dtype),
            outcome=Categorical(len(released.OUTCOMES), shape=(n,), device=device),
            shape=(n,),
        )
        bound = torch.ones(len(self.parameter_dims))
        self.action_spec = self.make_action_spec(-bound, bound)
        self.reward_spec = Unbounded(shape=(n, 1), device=device, dtype=dtype)
        self.done_spec = self.make_done_spec()

    def _set_seed(self, seed: int | None) -> None:
        self._seed = counter_rng.seed_tensor(0 if seed is None else seed, self.device)
        none = torch.zeros_like(self._environment)
        zeros = none.to(self.float_type)
        keymap = none + (self.keymap if self.controller == "incongruent" else released.NO_KEYMAP)
        self._state = released.ReleasedState(
            *[zeros] * 8, fuel=zeros, keymap=keymap, steps=none, outcome=none, episode=none - 1
        )

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask, given = None, {}
        if tensordict is not None:
            mask = tensordict.get("_reset", None)
            given = self._given_layout(tensordict)
        mask = torch.ones_like(self._environment, dtype=torch.bool) if mask is None else mask.reshape(self.num_envs)
        before, episode = self._state, self._state.episode + 1
        rng = counter_rng.key_for(self._seed, counter_rng.TRAINING, self._environment, episode)
        drawn = (counter_rng.uniform(rng, released.DRAW_KEYMAP) < 0.5).to(torch.int32)
        layout = given or self._drawn_layout(rng, mask)
        fresh = before._replace(**layout)
        fresh = fresh._replace(
            x=fresh.start_x,
            y=fresh.start_y,
            # The velocity stays what the last press of the episode before made it.
            fuel=torch.full_like(before.fuel, released.TANK),
            keymap=layout.get("keymap", torch.where(before.keymap == 0, drawn, before.keymap)),
            steps=torch.zeros_like(before.steps),
            outcome=torch.full_like(before.outcome, released.SAILING),
            episode=episode,
        )
        self._state = where(mask, fresh, before)
        return self._read()

    def _drawn_layout(self, rng: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Return the state's columns with new layouts where, of the rows of `mask` `[N]`, one is due."""
        is_due = mask & (self._state.episode < 0) if self.frozen_layouts else mask
        points = torch.stack(self._state[:4], -1)
        if is_due.any():
            points[is_due] = released.draw_layouts(rng[is_due], self.test_mode).to(points)
        return dict(zip(released.ReleasedState._fields[:4], points.unbind(-1), strict=True))

    def _given_layout(self, given: TensorDictBase) -> dict[str, Tensor]:
        """Check a user's layout and return the state's columns that it sets; none where none is given."""
        if not {"start", "goal", "keymap"} & set(given.keys()):
            return {}
        low, points = torch.tensor(released.LOW, device=self.device), {}
        for name in ("start", "goal"):
            point = given.get(name, None)
            if point is None or point.shape != (self.num_envs, 2):
                shape = None if point is None else list(point.shape)
                raise ValueError(f"reset: {name} has shape {shape}, but must be [{self.num_envs}, 2] (screen px)")
            points[name] = point.to(self.device, self.float_type)
            if not ((points[name] >= low) & (points[name] < low + released.SIZE)).all():
                x, y = ([corner, corner + released.SIZE] for corner in released.LOW)
                raise ValueError(f"reset: a {name} lies outside x in {x}, y in {y} (screen px)")
        if not ((points["start"] - points["goal"]).norm(dim=-1) >= 1.0).all():
            raise ValueError("reset: a start lies within 1 px of its goal")
        (start_x, start_y), (goal_x, goal_y) = (points[name].unbind(-1) for name in ("start", "goal"))
        columns = {"start_x": start_x, "start_y": start_y, "goal_x": goal_x, "goal_y": goal_y}
        keymap = given.get("keymap", None)
        if keymap is None:
            return columns
        if self.controller == "congruent":
            raise ValueError("reset: keymap is given, but the congruent boat has none")
        if keymap.shape != (self.num_envs,) or not ((keymap == 0) | (keymap == 1)).all():
            raise ValueError(f"reset: keymap must be 0 or 1 in shape [{self.num_envs}]")
        return {**columns, "keymap": keymap.to(self.device, torch.int32)}

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.check_action(tensordict)
        key, duration = self._checked_press(tensordict.get(keys.DISCRETE), tensordict.get(keys.PARAMETERS))
        before = self._state
        is_over = before.outcome != released.SAILING
        mask = tensordict.get("_step", None)
        if mask is not None:
            is_over = is_over | ~mask.reshape(self.num_envs)
        direction = self._directions[before.keymap.clamp(min=0).long(), key]
        after, reward = released.press(before, direction, duration, self.max_steps)
        self._state = where(is_over, before, after)
        return self._read().set(keys.REWARD, torch.where(is_over, 0.0, reward).unsqueeze(-1))

    def _checked_press(self, key: Tensor, durations: Tensor) -> tuple[Tensor, Tensor]:
        """Return the keys `[N]` and their durations `[N]`, clipped to [-1, 1]."""
        allowed = key.clamp(0, len(self.parameter_dims) - 1).long()
        duration = durations.gather(-1, allowed.unsqueeze(-1)).squeeze(-1)
        is_action = (key == allowed) & duration.isfinite()
        if not is_action.all():
            row = int((~is_action).nonzero()[0])
            raise ValueError(
                f"step: environment {row} got key={key[row].item()} (allowed 0, 1, 2), durations="
                f"{durations[row].tolist()} (the pressed key's must be finite)"
            )
        return allowed, duration.to(torch.float32).clamp(-1.0, 1.0)

    def _read(self) -> TensorDict:
        outcome = self._state.outcome.long()
        done, truncated = (outcome != released.SAILING).unsqueeze(-1), (outcome == released.TIME_LIMIT).unsqueeze(-1)
        leaves = {
            keys.OBSERVATION: released.observe(self._state, self.controller == "congruent", self.is_scaled),
            keys.OUTCOME: outcome,
            keys.DONE: done,
            keys.TERMINATED: done & ~truncated,
            keys.TRUNCATED: truncated,
        }
        return TensorDict(leaves, batch_size=self.batch_size, device=self.device)
