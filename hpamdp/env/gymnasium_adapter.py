"""Gymnasium environments over batched ones: `GymnasiumAdapter` (one environment) and `GymnasiumVectorAdapter` (many).

Nothing here needs torch, which takes seconds to import and microseconds for each operation.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from hpamdp.env.gymnasium_checks import as_array, check_render_mode, reset_options
from hpamdp.env.kernel_rows import KernelRows
from hpamdp.env.kernels import OUTCOME_ROW

RenderMode = Literal["rgb_array"] | None


class After(NamedTuple):
    """What follows an action: observations `[N, observation_dim]`, rewards, terminations and truncations `[N]`."""

    observations: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray


class NumpyRows:
    """A batched environment with NumPy in and out, for one environment or many.

    Args:
        rows: `KernelRows`, or an object with its methods, which moves the environments.
        batch: `()` for one environment, `(N,)` for many.
    """

    action_space: spaces.Space
    observation_space: spaces.Space
    final_infos: tuple[str, ...]  # infos that exist only once an episode is over

    def __init__(self, rows: Any, batch: tuple[int, ...]) -> None:
        self.is_reset = False
        self.rows: KernelRows = rows
        self._batch = batch
        self._num_envs = batch[0] if batch else 1

    def reset(self, seed: int | None, options: Mapping[str, Any] | None, mask: np.ndarray | None = None) -> np.ndarray:
        """Start new episodes, in the rows of `mask` or in all, and return the observations `[N, observation_dim]`."""
        columns = self._start_columns(options or {})
        if seed is not None:
            self.rows.begin(seed)
        self.is_reset = True
        results = self.rows.restart(mask)
        if columns:
            self.rows.put(columns, mask)
            results = self.rows.read()
        return results.observations[0]

    def step(self, action: Any, *, restarts: bool = False) -> After:
        """Return what follows an action in every environment.

        With `restarts`, environments whose episode was over start a new one instead, whatever their action is.
        """
        if not self.is_reset:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        leaves = self._leaves(action)
        results = self.rows.act_or_restart(*leaves) if restarts else self.rows.act(*leaves)
        if isinstance(results, int):
            raise self._invalid(results, leaves)
        return After(results.observations[0], results.rewards, results.flags[0, 1], results.flags[0, 2])

    @property
    def is_over(self) -> np.ndarray:
        """Which episodes are over, bool `[N]`."""
        return self.rows.integers[OUTCOME_ROW] != 0

    @property
    def state(self) -> Any:
        """The columns of the state, a named tuple of tensors or arrays `[N]` that stay as they are."""
        raise NotImplementedError

    def infos(self) -> dict[str, np.ndarray]:
        """Return the infos, `[N]` each."""
        raise NotImplementedError

    def info(self) -> dict[str, Any]:
        """Return the infos of the first environment as Python's numbers."""
        raise NotImplementedError

    def _start_columns(self, options: Mapping[str, Any]) -> Mapping[int, np.ndarray]:
        """Check the options of a reset and return the columns of the state that they set, by their places."""
        reset_options(options)
        return {}

    def _leaves(self, action: Any) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
        """Check an action's structure, types and shapes; return options, discrete actions and parameters."""
        raise NotImplementedError

    def _integers(self, name: str, value: Any) -> np.ndarray:
        """Return a leaf of integers, int64 `[N]`."""
        array = as_array(f"step: {name}", value, self._batch, is_integer=True)
        if array.dtype != np.int64 or not array.flags.c_contiguous:
            array = np.ascontiguousarray(array, np.int64)
        return array if self._batch else array.reshape(1)

    def _invalid(self, row: int, leaves: tuple[Any, Any, Any]) -> ValueError:
        """Return the error for the action of a row, given the leaves of all rows."""
        raise NotImplementedError


class GymnasiumAdapter(gymnasium.Env):
    """One environment.

    Args:
        problem: the environment with NumPy in and out.
        render_mode: None or `rgb_array` (`render` returns uint8 `[height, width, 3]`).

    `reset(seed=s)` starts the first episode of seed s, `reset()` continues with the next one. The generators of torch,
    NumPy and Python are neither read nor moved.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the state is unchanged.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (Gymnasium's own declaration)
    own_time_limit: int  # steps after which the environment itself ends an episode
    training_begins_elsewhere: bool = False

    def __init__(self, problem: NumpyRows, render_mode: RenderMode) -> None:
        check_render_mode(type(self).__name__, render_mode)
        self._problem = problem
        self.action_space = problem.action_space
        self.observation_space = problem.observation_space
        self.render_mode = render_mode
        self._track: list[Any] = []  # the states of the episode so far, if they are to be drawn

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see the module's docstring for `options`."""
        options = reset_options(options, allowed=None)
        super().reset(seed=seed)
        if seed is None and not self._problem.is_reset:
            seed = int(self.np_random.integers(2**31))
        observation = self._problem.reset(seed, options)[0]
        if self.render_mode is not None:
            self._track = [self._problem.state]
        return observation, self._problem.info()

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take an action. After the end of the episode the state stays unchanged, and the reward is 0."""
        is_drawn = self.render_mode is not None and not self._problem.is_over[0]
        observations, rewards, terminations, truncations = self._problem.step(action)
        if is_drawn:
            self._track.append(self._problem.state)
        return observations[0], rewards.item(), terminations.item(), truncations.item(), self._problem.info()

    def close(self) -> None:
        """End the episode; the environment must be reset before it is used again."""
        self._problem.is_reset = False

    def render(self) -> np.ndarray | None:
        """Return a picture of the episode so far, uint8 `[height, width, 3]`; None without a render mode."""
        if self.render_mode is None:
            name = type(self).__name__
            gymnasium.logger.warn(f'{name}: render needs an environment that was made with render_mode="rgb_array"')
            return None
        if not self._problem.is_reset:
            raise gymnasium.error.ResetNeeded("render: call reset first")
        return self._draw()

    def _draw(self) -> np.ndarray:
        raise NotImplementedError


class GymnasiumVectorAdapter(VectorEnv):
    """`num_envs` environments in one batch.

    Args:
        problem: the environments with NumPy in and out.
        num_envs: number of environments N.
        autoreset_mode: when finished episodes start again. With `NextStep` they do in the next step, which ignores
            their actions. With `SameStep` they do in the same step; the last observations and infos are
            `infos["final_obs"]` and `infos["final_info"]`. With `Disabled` they do only by `reset`.

    `reset` takes one integer seed for all environments; the episodes of environment i depend only on the seed and i,
    not on `num_envs`. The option `reset_mask` (bool `[N]`) of `reset` resets only these environments.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the state is unchanged.
    """

    def __init__(self, problem: NumpyRows, num_envs: int, autoreset_mode: AutoresetMode | str) -> None:
        self._problem = problem
        self.num_envs = num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.single_action_space = problem.action_space
        self.single_observation_space = problem.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes; see the class's and the module's docstrings for `options`."""
        options = reset_options(options, allowed=None)
        mask = options.pop("reset_mask", None)
        self._check_mask(mask, seed)
        super().reset(seed=seed)
        self.closed = False
        if seed is None and not self._problem.is_reset:
            seed = int(self.np_random.integers(2**31))
        observations = self._problem.reset(seed, options, mask)
        rows = np.ones(self.num_envs, bool) if mask is None else mask
        return observations, self._masked_infos(rows)

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take an action in every environment.

        Returns:
            Observations `[N, observation_dim]`, rewards, terminations and truncations `[N]`, and infos, each with a
            mask `_name` of the environments that have it.
        """
        observations, rewards, terminations, truncations = self._problem.step(
            actions, restarts=self.autoreset_mode == AutoresetMode.NEXT_STEP
        )
        rewards = rewards.astype(np.float64)
        is_done = terminations | truncations
        infos: dict[str, Any] = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and is_done.any():
            final_observations = np.full(self.num_envs, None, dtype=object)
            for row in is_done.nonzero()[0]:
                final_observations[row] = observations[row].copy()
            infos["final_obs"] = final_observations
            infos["_final_obs"] = is_done.copy()
            infos["final_info"] = self._masked_infos(is_done)
            infos["_final_info"] = is_done.copy()
            observations = self._problem.reset(None, None, is_done)
        infos.update(self._masked_infos(np.ones(self.num_envs, bool)))
        return observations, rewards, terminations, truncations, infos

    def close_extras(self, **kwargs: Any) -> None:
        """End the episodes, as Gymnasium's `close` asks; the environments must be reset before they are used again."""
        self._problem.is_reset = False

    def _check_mask(self, mask: Any, seed: int | None) -> None:
        if mask is None:
            return
        if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset: reset_mask must be a bool array of shape [{self.num_envs}] with a True in it")
        if not self._problem.is_reset or seed is not None:
            raise ValueError(
                "reset: the first reset and a reset with a seed are for all environments and take no reset_mask"
            )

    def _masked_infos(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return the infos of `rows` in Gymnasium's format: with each value a mask `_name` of those that have it."""
        is_over, everywhere = self._problem.is_over, bool(rows.all())
        masked: dict[str, np.ndarray] = {}
        for name, value in self._problem.infos().items():
            is_final = name in self._problem.final_infos
            has_value = rows & is_over if is_final else rows
            if everywhere and not is_final:
                masked[name] = value
            elif has_value.any():
                missing: Any = None if value.dtype == object else value.dtype.type(0)
                masked[name] = np.where(has_value.reshape(-1, *[1] * (value.ndim - 1)), value, missing)
            else:
                continue
            masked[f"_{name}"] = has_value.copy()
        return masked
