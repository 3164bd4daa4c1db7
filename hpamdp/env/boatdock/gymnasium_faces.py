"""The boat-docking task as Gymnasium environments over BoatDockEnv: `BoatDock` (one boat), `BoatDockVector` (many).

Actions are dicts or, with `action_format="tuple"`, the field's nested tuples: see `hpamdp.env.boatdock.numpy_boats`.

Options of `reset`: `start` and `goal` `[2]` in screen px and, with these, `controller` (0 or 1, not with
`controller="choose"`) and `keymap` (1 or 2). Infos: `outcome` (name), `fuel` (fraction of the tank), `presses`,
`controller` (0, 1, or -1 before one is chosen) and, once the episode is over, `score`.
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
from hpamdp.env.boatdock.episode import BoatState
from hpamdp.env.boatdock.numpy_boats import ActionFormat, NumpyBoats, to_numpy


class BoatDock(gymnasium.Env):
    """One boat to dock.

    Args:
        controller, keymap, reward, observation, motor_noise, sensor_noise, slip: the task, as in BoatDockEnv.
        action_format: `dict` or `tuple`; see `hpamdp.env.boatdock.numpy_boats`.
        render_mode: None or `rgb_array` (`render` returns uint8 `[480, 480, 3]`).

    `reset(seed=s)` starts with the first layout of seed s, `reset()` continues with the next one. The generators of
    torch, NumPy and Python are neither read nor moved.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the boat is unchanged.
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
        env = BoatDockEnv(
            1,
            controller=controller,
            keymap=keymap,
            reward=reward,
            observation=observation,
            motor_noise=_one_or_two(motor_noise),
            sensor_noise=sensor_noise,
            slip=slip,
        )
        self._boats = NumpyBoats(env, (), action_format)
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
        """Press a key; after the end of the episode the boat stays where it is and earns 0."""
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
            gymnasium.logger.warn('BoatDock: render needs an environment that was made with render_mode="rgb_array"')
            return None
        if not self._boats.is_reset:
            raise gymnasium.error.ResetNeeded("render: call reset first")
        state = self._boats.env.state
        return rendering.draw(
            rendering.Scene(
                start=(state.start_x.item(), state.start_y.item()),
                goal=(state.goal_x.item(), state.goal_y.item()),
                boat=(state.x.item(), state.y.item()),
                heading=(state.velocity_x.item(), state.velocity_y.item()),
                legs=tuple(self._legs),
                keymap=int(state.keymap),
                **self._info(),
            )
        )

    def _info(self) -> dict[str, Any]:
        values, is_done = self._boats.infos()
        if not is_done[0]:
            del values["score"]
        return {name: value[0] if value.dtype == object else value[0].item() for name, value in values.items()}


def _one_or_two(motor_noise: float | Sequence[float]) -> float | list[float]:
    """Return the motor noise as BoatDockEnv takes it."""
    return motor_noise if isinstance(motor_noise, int | float) else list(motor_noise)


def _leg(before: BoatState, after: BoatState) -> rendering.Leg:
    """Return the track of the press between two states of one boat."""
    start = (before.x.item(), before.y.item())
    end = (after.x.item(), after.y.item())
    # The fuel burnt is the time that the key was down, after noise and with what was left in the tank.
    pressed = physics.pressed_distance(before.fuel - after.fuel).item()
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    return rendering.Leg(start, end, min(pressed / length, 1.0) if length > 0.0 else 1.0)


class BoatDockVector(VectorEnv):
    """`num_envs` boats to dock in one BoatDockEnv.

    Args:
        num_envs: number of boats.
        controller, keymap, reward, observation, motor_noise, sensor_noise, slip: the task, as in BoatDockEnv.
        action_format: `dict` or `tuple`; see `hpamdp.env.boatdock.numpy_boats`.
        autoreset_mode: when finished boats start again: in the next step (which ignores their actions), in the same
            step (the last observations and infos are `infos["final_obs"]` and `infos["final_info"]`), or only by
            `reset`.
        compile_physics, device: as in BoatDockEnv.

    `reset` takes one integer seed for all boats; the layouts of boat i depend only on the seed and i, not on
    `num_envs`. The options of `reset` have one row for each boat; `reset_mask` (bool `[N]`) resets only these boats.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the boats are unchanged.
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
        env = BoatDockEnv(
            num_envs,
            controller=controller,
            keymap=keymap,
            reward=reward,
            observation=observation,
            motor_noise=_one_or_two(motor_noise),
            sensor_noise=sensor_noise,
            slip=slip,
            compile_physics=compile_physics,
            device=device,
        )
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
        """Start new episodes; see the class's and the module's docstrings for `options`."""
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        self._check_mask(mask, seed)
        super().reset(seed=seed)
        if seed is None and not self._boats.is_reset:
            seed = int(self.np_random.integers(2**31))
        observations = self._boats.reset(seed, options, mask)
        rows = np.ones(self.num_envs, bool) if mask is None else mask
        return observations, _with_masks(self._boats.infos(), rows)

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Press a key in every boat.

        Returns:
            Observations `[N, observation_dim]`, rewards, terminations and truncations `[N]`, and infos, each with a
            mask `_name` of the boats that have it.
        """
        _, was_done = self._boats.infos()
        is_next_step = self.autoreset_mode == AutoresetMode.NEXT_STEP
        after = self._boats.step(actions, ignored=was_done if is_next_step else None)
        observations = to_numpy(after[keys.OBSERVATION])
        rewards = to_numpy(after[keys.REWARD])[:, 0].astype(np.float64)
        terminations = to_numpy(after[keys.TERMINATED])[:, 0]
        truncations = to_numpy(after[keys.TRUNCATED])[:, 0]
        if is_next_step and was_done.any():
            # Finished boats stayed where they were and earned 0, so only the other results of their rows change.
            observations = self._boats.reset(None, None, was_done)
            terminations &= ~was_done
            truncations &= ~was_done
        is_done = terminations | truncations
        infos: dict[str, Any] = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and is_done.any():
            final_observations = np.full(self.num_envs, None, dtype=object)
            for row in is_done.nonzero()[0]:
                final_observations[row] = observations[row].copy()
            infos["final_obs"] = final_observations
            infos["_final_obs"] = is_done.copy()
            infos["final_info"] = _with_masks(self._boats.infos(), is_done)
            infos["_final_info"] = is_done.copy()
            observations = self._boats.reset(None, None, is_done)
        infos.update(_with_masks(self._boats.infos(), np.ones(self.num_envs, bool)))
        return observations, rewards, terminations, truncations, infos

    def _check_mask(self, mask: Any, seed: int | None) -> None:
        if mask is None:
            return
        if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset: reset_mask must be a bool array of shape [{self.num_envs}] with a True in it")
        if not self._boats.is_reset or seed is not None:
            raise ValueError("reset: the first reset and a reset with a seed are for all boats and take no reset_mask")


def _with_masks(infos: tuple[dict[str, np.ndarray], np.ndarray], rows: np.ndarray) -> dict[str, np.ndarray]:
    """Return the infos of `rows` in Gymnasium's format: with each value a mask `_name` of the boats that have it."""
    values, is_done = infos
    masked: dict[str, np.ndarray] = {}
    for name, value in values.items():
        has_value = rows & is_done if name == "score" else rows
        if has_value.any():
            missing: Any = None if value.dtype == object else 0
            masked[name] = np.where(has_value, value, missing)
            masked[f"_{name}"] = has_value.copy()
    return masked
