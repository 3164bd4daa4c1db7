"""Gymnasium environments over batched ones: `Face` (one environment) and `VectorFace` (many).

`CounterFace` and `CounterVectorFace` are those of any `CounterEnv`, whose id a problem registers with the path of its
class. Their actions are the field's nested tuples, `(discrete action, (parameters of action 0, ..., of action K-1))`;
batched spaces are Gymnasium's own: every leaf has a leading `[N]`. Only the parameters of the chosen action count.

Infos: `outcome` (name), `steps` (actions so far) and, once the episode is over, `is_success`.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, Literal, Protocol

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict, TensorDictBase

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.counter_env import GOING_ON, SUCCESS, CounterEnv

RenderMode = Literal["rgb_array"] | None


class NumpyEnv(Protocol):
    """A batched environment with NumPy in and out, for one environment or many."""

    is_reset: bool
    action_space: spaces.Space
    observation_space: spaces.Space
    final_infos: tuple[str, ...]  # infos that only episodes have that are over

    @property
    def state(self) -> Any:
        """The columns of the state, a named tuple of tensors `[N]`."""

    def reset(self, seed: int | None, options: Mapping[str, Any] | None, mask: np.ndarray | None = None) -> np.ndarray:
        """Start new episodes, in the rows of `mask` or in all, and return the observations `[N, observation_dim]`."""

    def step(self, action: Any, ignored: np.ndarray | None = None) -> TensorDictBase:
        """Return what follows an action in every environment; `ignored` rows may hold any action."""

    def infos(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the infos, `[N]` each, and which episodes are over."""


class Face(gymnasium.Env):
    """One environment.

    Args:
        problem: the environment with NumPy in and out.
        render_mode: None or `rgb_array` (`render` returns uint8 `[480, 480, 3]`).

    `reset(seed=s)` starts the first episode of seed s, `reset()` continues with the next one. The generators of torch,
    NumPy and Python are neither read nor moved.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the state is unchanged.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(self, problem: NumpyEnv, render_mode: RenderMode) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"{type(self).__name__}: render_mode={render_mode!r}, but must be None or rgb_array")
        self._problem = problem
        self.action_space = problem.action_space
        self.observation_space = problem.observation_space
        self.render_mode = render_mode
        self._track: list[Any] = []  # the states of the episode so far, if they are to be drawn

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see the module's docstring for `options`."""
        super().reset(seed=seed)
        if seed is None and not self._problem.is_reset:
            seed = int(self.np_random.integers(2**31))
        observation = self._problem.reset(seed, options)[0]
        self._track = [self._problem.state]
        return observation, self._info()

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take an action; after the end of the episode everything stays as it is and earns 0."""
        was_done = bool(self._problem.infos()[1][0])
        after = self._problem.step(action)
        if self.render_mode is not None and not was_done:
            self._track.append(self._problem.state)
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
            name = type(self).__name__
            gymnasium.logger.warn(f'{name}: render needs an environment that was made with render_mode="rgb_array"')
            return None
        if not self._problem.is_reset:
            raise gymnasium.error.ResetNeeded("render: call reset first")
        return self._draw()

    def _draw(self) -> np.ndarray:
        raise NotImplementedError

    def _info(self) -> dict[str, Any]:
        values, is_done = self._problem.infos()
        if not is_done[0]:
            values = {name: value for name, value in values.items() if name not in self._problem.final_infos}
        return {name: value[0] if value.dtype == object else value[0].item() for name, value in values.items()}


class VectorFace(VectorEnv):
    """`num_envs` environments in one batch.

    Args:
        problem: the environments with NumPy in and out.
        num_envs: how many they are.
        autoreset_mode: when finished episodes start again: in the next step (which ignores their actions), in the same
            step (the last observations and infos are `infos["final_obs"]` and `infos["final_info"]`), or only by
            `reset`.

    `reset` takes one integer seed for all environments; the episodes of environment i depend only on the seed and i,
    not on `num_envs`. The option `reset_mask` (bool `[N]`) of `reset` resets only these environments.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the state is unchanged.
    """

    def __init__(self, problem: NumpyEnv, num_envs: int, autoreset_mode: AutoresetMode | str) -> None:
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
        options = dict(options or {})
        mask = options.pop("reset_mask", None)
        self._check_mask(mask, seed)
        super().reset(seed=seed)
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
        _, was_done = self._problem.infos()
        is_next_step = self.autoreset_mode == AutoresetMode.NEXT_STEP
        after = self._problem.step(actions, ignored=was_done if is_next_step else None)
        observations = to_numpy(after[keys.OBSERVATION])
        rewards = to_numpy(after[keys.REWARD])[:, 0].astype(np.float64)
        terminations = to_numpy(after[keys.TERMINATED])[:, 0]
        truncations = to_numpy(after[keys.TRUNCATED])[:, 0]
        if is_next_step and was_done.any():
            # Finished episodes stayed as they were and earned 0, so only the other results of their rows change.
            observations = self._problem.reset(None, None, was_done)
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
            infos["final_info"] = self._masked_infos(is_done)
            infos["_final_info"] = is_done.copy()
            observations = self._problem.reset(None, None, is_done)
        infos.update(self._masked_infos(np.ones(self.num_envs, bool)))
        return observations, rewards, terminations, truncations, infos

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
        values, is_done = self._problem.infos()
        masked: dict[str, np.ndarray] = {}
        for name, value in values.items():
            has_value = rows & is_done if name in self._problem.final_infos else rows
            if has_value.any():
                missing: Any = None if value.dtype == object else value.dtype.type(0)
                masked[name] = np.where(has_value, value, missing)
                masked[f"_{name}"] = has_value.copy()
        return masked


class CounterFace(Face):
    """One environment of a `CounterEnv`.

    Args:
        problem: the environment's class as text, `package.module:Class`.
        render_mode: None or `rgb_array`.
        settings: what the class takes besides.
    """

    def __init__(self, problem: str, *, render_mode: RenderMode = None, **settings: Any) -> None:
        env = _load(problem)(1, **settings)
        super().__init__(NumpyCounterEnv(env, ()), render_mode)
        self._env = env

    def _draw(self) -> np.ndarray:
        return self._env.draw(self._track)


class CounterVectorFace(VectorFace):
    """`num_envs` environments of a `CounterEnv`.

    Args:
        problem: the environment's class as text, `package.module:Class`.
        num_envs, autoreset_mode: as in `VectorFace`.
        settings: what the class takes besides, such as `device`.
    """

    def __init__(
        self,
        problem: str,
        *,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        env = _load(problem)(num_envs, **settings)
        super().__init__(NumpyCounterEnv(env, (num_envs,)), num_envs, autoreset_mode)


class NumpyCounterEnv(NumpyEnv):
    """A `CounterEnv` with NumPy in and out: one environment (`batch=()`) or many (`batch=(N,)`)."""

    final_infos = ("is_success",)

    def __init__(self, env: CounterEnv, batch: tuple[int, ...]) -> None:
        self.is_reset = False
        self.action_space = _action_space(env)
        low, high = (np.array(side, np.float32) for side in env.observation_bounds)
        self.observation_space = spaces.Box(low, high, dtype=np.float32)
        self._env = env
        self._batch = batch

    @property
    def state(self) -> Any:
        """The columns of the state."""
        return self._env.state

    def reset(self, seed: int | None, options: Mapping[str, Any] | None, mask: np.ndarray | None = None) -> np.ndarray:
        """Start new episodes; there are no options."""
        if options:
            raise ValueError(f"reset: unknown options {sorted(options)}; there are none")
        if seed is not None:
            self._env.set_seed(seed, static_seed=True)
        given = TensorDict(batch_size=self._env.batch_size, device=self._env.device)
        if mask is not None:
            given["_reset"] = torch.from_numpy(mask.copy()).to(self._env.device).unsqueeze(-1)
        self.is_reset = True
        return to_numpy(self._env.reset(given)[keys.OBSERVATION])

    def step(self, action: Any, ignored: np.ndarray | None = None) -> TensorDictBase:
        """Return what follows an action in every environment."""
        if not self.is_reset:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        discrete, parameters = self._leaves(action)
        if ignored is not None:
            rows = torch.from_numpy(ignored)
            discrete[rows] = 0
            parameters[rows] = 0.0
        td = TensorDict(batch_size=self._env.batch_size, device=self._env.device)
        td[keys.DISCRETE] = discrete
        td[keys.PARAMETERS] = parameters
        return self._env.step(td)["next"]

    def infos(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the infos, `[N]` each, and which episodes are over."""
        outcome = to_numpy(self._env.state.outcome)
        values = {
            "outcome": np.array(self._env.outcomes, dtype=object)[outcome],
            "steps": to_numpy(self._env.state.steps).astype(np.int64),
            "is_success": outcome == SUCCESS,
        }
        return values, outcome != GOING_ON

    def _leaves(self, action: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Check the structure, types and shapes of an action and return its leaves, `[N]` and `[N, num_parameters]`."""
        if not isinstance(action, (tuple, list)) or len(action) != 2:
            raise ValueError(f"step: the action must be a tuple (discrete, parameters), but is {describe(action)}")
        discrete, parameters = action
        dims = self._env.parameter_dims
        if not isinstance(parameters, (tuple, list)) or len(parameters) != len(dims):
            raise ValueError(f"step: parameters must be a tuple of length {len(dims)}, but is {describe(parameters)}")
        given = as_array("step: discrete", discrete, self._batch, is_integer=True).astype(np.int64)
        arrays = [
            as_array(f"step: parameters of action {number}", array, (*self._batch, dim))
            for number, (array, dim) in enumerate(zip(parameters, dims, strict=True))
        ]
        joined = np.concatenate(arrays, axis=-1).astype(np.float32).reshape(self._env.num_envs, sum(dims))
        return torch.from_numpy(given.reshape(self._env.num_envs)), torch.from_numpy(joined)


def _load(problem: str) -> type[Any]:
    """Return the class that `package.module:Class` names."""
    module, _, name = problem.partition(":")
    return getattr(importlib.import_module(module), name)


def _action_space(env: PAMDPEnv) -> spaces.Tuple:
    """Return the space `Tuple(Discrete, Tuple(Box, ...))` of the actions of one environment."""
    bounds = env.full_action_spec_unbatched[keys.PARAMETERS].space
    ends = np.cumsum(env.parameter_dims)[:-1]
    lows, highs = (np.split(side.cpu().numpy().reshape(-1), ends) for side in (bounds.low, bounds.high))
    boxes = [spaces.Box(low, high, dtype=np.float32) for low, high in zip(lows, highs, strict=True)]
    return spaces.Tuple((spaces.Discrete(len(boxes)), spaces.Tuple(boxes)))


def as_array(name: str, value: Any, shape: tuple[int, ...], *, is_integer: bool = False) -> np.ndarray:
    """Return a value as an array.

    Raises:
        ValueError: it is no array of this shape and kind; the message calls it `name`.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be an array, but is {describe(value)}") from None
    if array.dtype.kind not in ("iu" if is_integer else "iuf"):
        raise ValueError(f"{name} has type {array.dtype}, but must be {'integer' if is_integer else 'a number'}")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {list(array.shape)}, but must be {list(shape)}")
    return array


def describe(value: Any) -> str:
    """Return what a value is, for an error."""
    kind = type(value).__name__
    if isinstance(value, Mapping):
        return f"a {kind} with keys {', '.join(map(str, value))}"
    if isinstance(value, (tuple, list)):
        return f"a {kind} of length {len(value)}"
    return f"a {kind}"


def to_numpy(tensor: torch.Tensor) -> np.ndarray:
    """Return a copy of a tensor as an array that shares no memory with it."""
    return tensor.cpu().numpy().copy()
