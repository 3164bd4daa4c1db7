"""Gymnasium faces of the boat-docking task: `BoatDock` (one boat) and `BoatDockVector` (many), both over BoatDockEnv.

Actions are dicts or, with `action_format="tuple"`, the field's nested tuples: see `hpamdp.env.boatdock.numpy_boats`.

`reset` options: `start` and `goal` `[2]` in screen px and, beside them, `controller` (0 or 1, not with
`controller="choose"`) and `keymap` (1 or 2). Infos: `outcome` (name), `fuel` (fraction of the tank), `presses`,
`controller` (0, 1, or -1 while none is chosen) and, once the episode is over, `score`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from hpamdp import keys
from hpamdp.env.boatdock import physics, rendering
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.episode import BoatState, Rules
from hpamdp.env.boatdock.numpy_boats import ActionFormat, NumpyBoats, to_numpy


class BoatDock(gymnasium.Env):
    """One boat to dock.

    Args:
        controller, keymap, reward, observation, motor_noise, sensor_noise, slip: the task, as in BoatDockEnv.
        action_format: `dict` or `tuple`; see `hpamdp.env.boatdock.numpy_boats`.
        render_mode: None or `rgb_array` (uint8 `[480, 480, 3]` from `render`).

    `reset(seed=s)` starts the layouts of seed s from the first, `reset()` goes on to the next one. The generators of
    torch, numpy and Python are neither read nor moved.

    Raises:
        ValueError: an argument, action or reset option that is out of range; the boat is left as it was.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(
        self,
        *,
        controller: Literal["choose", "congruent", "incongruent", "random"] = "choose",
        keymap: Literal[1, 2, "random"] = 1,
        reward: Literal["paper", "sparse"] = "paper",
        observation: Literal["scaled", "pixels"] = "scaled",
        motor_noise: float | Sequence[float] = 0.0,
        sensor_noise: float = 0.0,
        slip: float = 0.0,
        action_format: ActionFormat = "dict",
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"BoatDock: render_mode={render_mode!r}, but must be None or rgb_array")
        rules = Rules(controller, keymap, reward, observation, motor_noise, sensor_noise, slip)
        self._boats = NumpyBoats(BoatDockEnv(1, **rules._asdict()), (), action_format)
        self.action_space = self._boats.action_space
        self.observation_space = self._boats.observation_space
        self.render_mode = render_mode
        self._legs: list[rendering.Leg] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see the module's docstring for `options`."""
        super().reset(seed=seed)
        if seed is None and not self._boats.is_reset:
            seed = int(self.np_random.integers(2**31))
        observation = self._boats.reset(seed, options)[0]
        self._legs = []
        return observation, self._info()

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Press a key; after the episode's end the boat stays where it is and earns 0."""
        before = self._boats.env.state
        after = self._boats.step(action)
        if self.render_mode is not None and before.outcome.item() == physics.SAILING:
            self._legs.append(_leg(before, self._boats.env.state))
        return (
            to_numpy(after[keys.OBSERVATION])[0],
            after[keys.REWARD].item(),
            after[keys.TERMINATED].item(),
            after[keys.TRUNCATED].item(),
            self._info(),
        )

    def render(self) -> np.ndarray | None:
        """Return a picture of the episode so far, uint8 `[480, 480, 3]`; None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn('BoatDock: render needs render_mode="rgb_array", given when the environment is made')
            return None
        if not self._boats.is_reset:
            raise gymnasium.error.ResetNeeded("render: call reset first")
        state, info = self._boats.env.state, self._info()
        return rendering.draw(
            rendering.Scene(
                start=(state.start_x.item(), state.start_y.item()),
                goal=(state.goal_x.item(), state.goal_y.item()),
                boat=(state.x.item(), state.y.item()),
                heading=(state.velocity_x.item(), state.velocity_y.item()),
                legs=tuple(self._legs),
                keymap=state.keymap.item(),
                **{"score": None, **info},
            )
        )

    def _info(self) -> dict[str, Any]:
        values, is_done = self._boats.infos()
        if not is_done[0]:
            del values["score"]
        return {name: value[0] if value.dtype == object else value[0].item() for name, value in values.items()}


def _leg(before: BoatState, after: BoatState) -> rendering.Leg:
    start, end = ((state.x.item(), state.y.item()) for state in (before, after))
    # The fuel tells how long the key was down, whatever noise and the tank made of the action.
    pressed = physics.pressed_distance(before.fuel - after.fuel).item()
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    return rendering.Leg(start, end, min(pressed / length, 1.0) if length > 0.0 else 1.0)


class BoatDockVector(VectorEnv):
    """`num_envs` boats to dock in one BoatDockEnv.

    Args:
        num_envs: how many boats.
        controller, keymap, reward, observation, motor_noise, sensor_noise, slip: the task, as in BoatDockEnv.
        action_format: `dict` or `tuple`; see `hpamdp.env.boatdock.numpy_boats`.
        autoreset_mode: when finished boats start again: at the next step (which ignores their actions), in the same
            step (what ended is in `infos["final_obs"]` and `infos["final_info"]`), or by `reset` only.
        compile_physics, device: as in BoatDockEnv.

    `reset` takes one integer seed for all boats; boat i's layouts are functions of the seed and i alone, whatever
    `num_envs`. The options hold one row a boat; `reset_mask` (bool `[N]`) starts these boats' episodes alone.

    Raises:
        ValueError: an argument, action or reset option that is out of range; the boats are left as they were.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        controller: Literal["choose", "congruent", "incongruent", "random"] = "choose",
        keymap: Literal[1, 2, "random"] = 1,
        reward: Literal["paper", "sparse"] = "paper",
        observation: Literal["scaled", "pixels"] = "scaled",
        motor_noise: float | Sequence[float] = 0.0,
        sensor_noise: float = 0.0,
        slip: float = 0.0,
        action_format: ActionFormat = "dict",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        compile_physics: bool = False,
        device: torch.device | str = "cpu",
    ) -> None:
        rules = Rules(controller, keymap, reward, observation, motor_noise, sensor_noise, slip)
        env = BoatDockEnv(num_envs, **rules._asdict(), compile_physics=compile_physics, device=device)
        self._boats = NumpyBoats(env, (num_envs,), action_format)
        self.num_envs = num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.single_action_space = self._boats.action_space
        self.single_observation_space = self._boats.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes; see the class's docstring for `options`."""
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        self._check_mask(mask, seed)
        super().reset(seed=seed)
        if seed is None and not self._boats.is_reset:
            seed = int(self.np_random.integers(2**31))
        observations = self._boats.reset(seed, options, mask)
        return observations, _with_masks(self._boats.infos(), np.ones(self.num_envs, bool) if mask is None else mask)

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Press a key in every boat: observations `[N, obs]`, rewards and flags `[N]`, infos with `_key` masks."""
        everyone = np.ones(self.num_envs, bool)
        was_done = self._boats.infos()[1]
        is_next_step = self.autoreset_mode == AutoresetMode.NEXT_STEP
        after = self._boats.step(actions, ignored=was_done if is_next_step else None)
        observations, infos = to_numpy(after[keys.OBSERVATION]), {}
        terminations, truncations = (to_numpy(after[key])[:, 0] for key in (keys.TERMINATED, keys.TRUNCATED))
        rewards = to_numpy(after[keys.REWARD])[:, 0].astype(np.float64)
        if is_next_step and was_done.any():
            # Finished boats stayed where they were and earned 0, so that their rows can be overwritten.
            observations = self._boats.reset(None, None, was_done)
            terminations, truncations = terminations & ~was_done, truncations & ~was_done
        is_done = terminations | truncations
        if self.autoreset_mode == AutoresetMode.SAME_STEP and is_done.any():
            final = np.full(self.num_envs, None, dtype=object)
            for row in is_done.nonzero()[0]:
                final[row] = observations[row].copy()
            infos = {
                "final_obs": final,
                "_final_obs": is_done.copy(),
                "final_info": _with_masks(self._boats.infos(), is_done),
                "_final_info": is_done.copy(),
            }
            observations = self._boats.reset(None, None, is_done)
        return observations, rewards, terminations, truncations, infos | _with_masks(self._boats.infos(), everyone)

    def _check_mask(self, mask: Any, seed: int | None) -> None:
        if mask is None:
            return
        if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset: reset_mask must be a bool array of shape [{self.num_envs}] with a True in it")
        if not self._boats.is_reset or seed is not None:
            raise ValueError(
                "reset: the first reset and a seed concern every boat, so that no reset_mask goes with them"
            )


def _with_masks(infos: tuple[dict[str, np.ndarray], np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the infos of `rows` as Gymnasium keeps them: beside every key a mask of the boats that have it."""
    values, is_done = infos
    masked = {}
    for name, value in values.items():
        present = rows & is_done if name == "score" else rows
        if present.any():
            missing = None if value.dtype == object else 0
            masked |= {name: np.where(present, value, missing), f"_{name}": present.copy()}
    return masked
