"""Gymnasium environments of any `BatchedEnv`: `GymnasiumAdapter` (one environment) and `GymnasiumVectorAdapter` (many).

`hpamdp.env.registration` names their ids. An action has one of two formats. In batched spaces every leaf has a leading
`[N]`, as is usual in Gymnasium. Only the parameters of the chosen action count.

- `tuple`, the field's convention: `(discrete action, (parameters of action 0, ..., of action K-1))`. If the agent
  chooses an option, it comes first.
- `dict`: the discrete action and the parameters of all discrete actions side by side, named as in
  `BatchedEnv.action_names`; if the agent chooses an option, also `option`.

Infos:
- always: `outcome` (its name), and those of `BatchedEnv.infos`, such as `steps`;
- if the problem forbids something: its masks;
- once the episode is over: those of `BatchedEnv.final_infos`, such as `is_success`.

The options of a reset are `BatchedEnv.start_shapes`.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDict, TensorDictBase

from hpamdp import keys
from hpamdp.env.batched_env import GOING_ON, ActionFormat, BatchedEnv
from hpamdp.env.errors import ProblemError
from hpamdp.env.gymnasium_checks import as_array, check_render_mode, describe, parameter_arrays, reset_options
from hpamdp.env.gymnasium_form import DictForm, VectorForm
from hpamdp.env.kernel_rows import KernelRows, Results
from hpamdp.env.kernels import OUTCOME_ROW
from hpamdp.settings import SettingError

_WIDE = {"b": np.bool_, "i": np.int64, "f": np.float64}  # the types of Python's numbers, by NumPy's kind


class After(NamedTuple):
    """What follows an action: observations `[N, ...]`, rewards, terminations and truncations `[N]`."""

    observations: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray


class TensorRows:
    """The methods of `KernelRows`, for a `BatchedEnv` that its tensor functions move: on a GPU, or compiled."""

    def __init__(self, env: BatchedEnv) -> None:
        self._env = env

    @property
    def floats(self) -> np.ndarray:
        """The float32 columns of the state."""
        columns = [to_numpy(column) for column in self._env.state if column.is_floating_point()]
        return np.stack(columns) if columns else np.empty((0, self._env.num_envs), np.float32)

    @property
    def integers(self) -> np.ndarray:
        """The int32 columns of the state."""
        return np.stack([to_numpy(column) for column in self._env.state if not column.is_floating_point()])

    def begin(self, seed: int) -> None:
        """Put every row before its first episode of training with this seed."""
        self._env.set_seed(seed, static_seed=True)

    def act(self, option: np.ndarray | None, discrete: np.ndarray, parameters: np.ndarray) -> Results:
        """Take an action in every row; an invalid one raises the environment's own error."""
        td = TensorDict(batch_size=self._env.batch_size, device=self._env.device)
        td[keys.DISCRETE], td[keys.PARAMETERS] = torch.from_numpy(discrete), torch.from_numpy(parameters)
        if option is not None:
            td[keys.OPTION] = torch.from_numpy(option)
        return self._results(self._env.step(td)["next"])

    def act_or_restart(self, option: np.ndarray | None, discrete: np.ndarray, parameters: np.ndarray) -> Results:
        """Take an action, and instead start a new episode where one is over; actions are not read there."""
        was_over = self.integers[OUTCOME_ROW] != GOING_ON
        option = None if option is None else np.where(was_over, 0, option)
        discrete, parameters = np.where(was_over, 0, discrete), np.where(was_over[:, None], np.float32(0.0), parameters)
        results = self.act(option, discrete, parameters)
        return self.restart(was_over)._replace(rewards=results.rewards) if was_over.any() else results

    def restart(self, mask: np.ndarray | None = None) -> Results:
        """Start new episodes, in the rows of `mask` or in all."""
        td = TensorDict(batch_size=self._env.batch_size, device=self._env.device)
        if mask is not None:
            td["_reset"] = torch.from_numpy(mask.copy()).to(self._env.device).unsqueeze(-1)
        return self._results(self._env.reset(td))

    def read(self) -> Results:
        """Return what is observed."""
        return self.restart(np.zeros(self._env.num_envs, np.bool_))

    def put(self, columns: Mapping[int, np.ndarray], mask: np.ndarray | None) -> None:
        """Set columns of the state by their places."""
        state = [to_numpy(column) for column in self._env.state]
        for place, column in columns.items():
            np.copyto(state[place], column, where=True if mask is None else mask)
        self._env.state = type(self._env.state)(*map(torch.from_numpy, state))

    def _results(self, td: TensorDictBase) -> Results:
        flags = np.stack([to_numpy(td[name])[:, 0] for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)])
        reward = td.get(keys.REWARD, None)
        return Results(
            observations=to_numpy(td[keys.OBSERVATION])[None],
            outcomes=to_numpy(td[keys.OUTCOME])[None],
            extras=np.empty((1, 0, len(flags[0])), np.float32),  # which no adapter reads
            flags=flags[None],
            rewards=np.zeros(len(flags[0]), np.float32) if reward is None else to_numpy(reward)[:, 0],
        )


class NumpyBatchedEnv:
    """A `BatchedEnv` with NumPy in and out: one environment (`batch=()`) or many (`batch=(N,)`).

    Args:
        problem: the environment's class as text, `package.module:Class`.
        batch: `()` or `(N,)`.
        action_format: `tuple` or `dict`; None for the problem's own.
        settings: what the class takes besides, such as `device`.
    """

    def __init__(
        self, problem: str, batch: tuple[int, ...], action_format: ActionFormat | None, settings: Mapping[str, Any]
    ) -> None:
        if "seed" in settings:  # since resets seed a Gymnasium environment
            raise SettingError(f"seed={settings['seed']}: no setting of the environment; give it to reset")
        module, _, name = problem.partition(":")
        env: BatchedEnv = getattr(importlib.import_module(module), name)(*(batch or (1,)), **settings)
        if not env.components.is_single or any(env.integer_parameters):
            raise ProblemError(f"{env.title}: the Gymnasium form of a BatchedEnv has one component of real parameters")
        action_format = env.action_format if action_format is None else action_format
        if action_format not in ("dict", "tuple"):
            raise SettingError(f"{env.title}: action_format={action_format!r}, but must be dict or tuple")
        self.env = env
        self.is_reset = False
        # Steps on the CPU need no torch: its operations take microseconds each.
        self.rows: KernelRows | TensorRows = TensorRows(env) if env.rows is None else env.rows
        self._batch = batch
        self._is_tuple = action_format == "tuple"
        self._has_choice, self._num_parameters = env.has_choice, sum(env.parameter_dims)
        self._names = (*(("option",) if env.has_choice else ()), *env.action_names)
        self._name_set = {*self._names}
        self.action_space = (VectorForm if self._is_tuple else DictForm)(env).action_space
        self._picture = env.observation_entries[0].shape if env.observation_entries else None
        if self._picture is None:
            low, high = (np.array(side, np.float32) for side in env.observation_bounds)
            self.observation_space = spaces.Box(low, high, dtype=np.float32)
        else:
            pixels: Any = np.uint8  # the annotation of Box knows float32 alone
            self.observation_space = spaces.Box(0, 255, self._picture, pixels)
        self._outcome_names = np.array(env.outcomes, dtype=object)
        self._has_masks = bool(env.masks())
        self.final_infos = tuple(env.final_infos(self.rows.floats, self.rows.integers))

    @property
    def state(self) -> Any:
        """The columns of the state."""
        return self.env.state

    @property
    def is_over(self) -> np.ndarray:
        """Which episodes are over, bool `[N]`."""
        return self.rows.integers[OUTCOME_ROW] != GOING_ON

    def reset(self, seed: int | None, options: Mapping[str, Any] | None, mask: np.ndarray | None = None) -> np.ndarray:
        """Start new episodes, in the rows of `mask` or in all, and return the observations `[N, ...]`."""
        columns = self._start_columns(options or {})
        if seed is not None:
            self.rows.begin(seed)
        self.is_reset = True
        results = self.rows.restart(mask)
        if columns:
            self.rows.put(columns, mask)
            results = self.rows.read()
        return self._shown(results.observations[0])

    def step(self, action: Any, *, restarts: bool = False) -> After:
        """Return what follows an action in every environment.

        With `restarts`, environments whose episode was over start a new one instead, whatever their action is.
        """
        if not self.is_reset:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        leaves = self._leaves(action)
        results = self.rows.act_or_restart(*leaves) if restarts else self.rows.act(*leaves)
        if isinstance(results, int):
            raise self.env.invalid_action(results, *leaves)
        terminated, truncated = results.flags[0, 1], results.flags[0, 2]
        if self.env.limit_terminates:
            terminated, truncated = terminated | truncated, np.zeros_like(truncated)
        observations = results.observations[0]
        return After(
            observations if self._picture is None else self._shown(observations), results.rewards, terminated, truncated
        )

    def infos(self) -> dict[str, np.ndarray]:
        """Return the infos, `[N]` each."""
        floats, integers = self.rows.floats, self.rows.integers
        infos = {"outcome": self._outcome_names[integers[OUTCOME_ROW]]}
        for name, value in self.env.infos(floats, integers).items():
            infos[name] = value.astype(_WIDE[value.dtype.kind])
        if self._has_masks:
            infos.update(self._masks())
        infos.update(self.env.final_infos(floats, integers))
        return infos

    def info(self) -> dict[str, Any]:
        """Return the infos of the first environment as Python's numbers."""
        floats, integers = self.rows.floats[:, 0], self.rows.integers[:, 0].tolist()
        outcome = integers[OUTCOME_ROW]
        info = {"outcome": self.env.outcomes[outcome], **self.env.infos(floats, integers)}
        if outcome != GOING_ON:
            info.update(self.env.final_infos(floats, integers))
        for name, value in info.items():
            if isinstance(value, np.generic):
                info[name] = value.item()
        if self._has_masks:
            info.update({name: mask[0] for name, mask in self._masks().items()})
        return info

    def _masks(self) -> dict[str, np.ndarray]:
        return {name: to_numpy(mask) for name, mask in self.env.masks().items()}

    def _shown(self, observations: np.ndarray) -> np.ndarray:
        """Return the pictures `[N, *shape]` of vectors, if the problem shows pictures."""
        if self._picture is None:
            return observations
        if self.env.rows is not None:  # the tensor functions have drawn them already
            observations = self.env.shown(torch.from_numpy(observations)).numpy()
        return observations.reshape(-1, *self._picture)

    def _start_columns(self, options: Mapping[str, Any]) -> Mapping[int, np.ndarray]:
        """Check the options of a reset and return the columns of the state that they set, by their places."""
        shapes = self.env.start_shapes
        given = {}
        for name, value in reset_options(options, [*shapes]).items():
            array = as_array(f"reset: {name}", value, self._batch + shapes[name], is_integer=shapes[name] == ())
            given[name] = array.reshape(self.env.num_envs, *shapes[name])
        if not given:
            return {}
        places = {name: place for place, name in enumerate(self.state._fields)}
        return {places[name]: column for name, column in self.env.start_columns(given).items()}

    def _leaves(self, action: Any) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
        """Check an action's structure, types and shapes; return options, discrete actions and parameters."""
        if self._is_tuple:
            action = self._named(action)
        elif not isinstance(action, dict | Mapping) or action.keys() != self._name_set:
            names = ", ".join(self._names)
            raise ValueError(f"step: the action must be a dict with keys {names}, but is {describe(action)}")
        discrete, parameters = self.env.action_names
        given = as_array("step: parameters", action[parameters], (*self._batch, self._num_parameters))
        option = self._integers("option", action["option"]) if self._has_choice else None
        if given.dtype != np.float32 or not given.flags.c_contiguous:
            given = np.ascontiguousarray(given, np.float32)
        return option, self._integers(discrete, action[discrete]), given if self._batch else given.reshape(1, -1)

    def _named(self, action: Any) -> dict[str, Any]:
        """Return a tuple action as a dict."""
        if not isinstance(action, (tuple, list)) or len(action) != len(self._names):
            names = ", ".join(self._names)
            raise ValueError(f"step: the action must be a tuple ({names}), but is {describe(action)}")
        named = dict(zip(self._names, action, strict=True))
        own = parameter_arrays(action[-1], self.env.parameter_dims, self._batch)
        return {**named, self._names[-1]: np.concatenate(own, axis=-1)}

    def _integers(self, name: str, value: Any) -> np.ndarray:
        array = as_array(f"step: {name}", value, self._batch, is_integer=True)
        if array.dtype != np.int64 or not array.flags.c_contiguous:
            array = np.ascontiguousarray(array, np.int64)
        return array if self._batch else array.reshape(1)


class GymnasiumAdapter(gymnasium.Env):
    """One environment of a `BatchedEnv`.

    Args:
        problem: the environment's class as text, `package.module:Class`.
        action_format: `tuple` or `dict`; None for the problem's own. See the module's docstring.
        render_mode: None or `rgb_array` (`render` returns uint8 `[480, 480, 3]`).
        settings: what the class takes besides.

    `reset(seed=s)` starts the first episode of seed s, `reset()` continues with the next one. The generators of torch,
    NumPy and Python are neither read nor moved.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the state is unchanged.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(
        self,
        problem: str,
        *,
        action_format: ActionFormat | None = None,
        render_mode: Literal["rgb_array"] | None = None,
        **settings: Any,
    ) -> None:
        if "num_envs" in settings:
            raise SettingError(f"num_envs={settings['num_envs']}: this is one environment; use gymnasium.make_vec")
        self._problem = NumpyBatchedEnv(problem, (), action_format, settings)
        self._env = env = self._problem.env
        check_render_mode(env.title, render_mode)
        if render_mode is not None and type(env).draw is BatchedEnv.draw:
            raise SettingError(f"render_mode={render_mode!r}: {env.title} has no pictures")
        self.action_space = self._problem.action_space
        self.observation_space = self._problem.observation_space
        self.render_mode = render_mode
        self.own_time_limit = env.max_steps  # after which the environment itself ends an episode
        self.training_begins_elsewhere = env.training_begins_elsewhere
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
        """Return a picture of the episode so far, uint8 `[480, 480, 3]`; None without a render mode."""
        if self.render_mode is None:
            title = self._env.title
            gymnasium.logger.warn(f'{title}: render needs an environment that was made with render_mode="rgb_array"')
            return None
        if not self._problem.is_reset:
            raise gymnasium.error.ResetNeeded("render: call reset first")
        return self._env.draw(self._track)


class GymnasiumVectorAdapter(VectorEnv):
    """`num_envs` environments of a `BatchedEnv`, in one batch.

    Args:
        problem: the environment's class as text, `package.module:Class`.
        num_envs: number of environments N.
        autoreset_mode: when finished episodes start again. With `NextStep` they do in the next step, which ignores
            their actions. With `SameStep` they do in the same step; the last observations and infos are
            `infos["final_obs"]` and `infos["final_info"]`. With `Disabled` they do only by `reset`.
        action_format: `tuple` or `dict`; None for the problem's own. See the module's docstring.
        settings: what the class takes besides, such as `device`.

    `reset` takes one integer seed for all environments; the episodes of environment i depend only on the seed and i,
    not on `num_envs`. The option `reset_mask` (bool `[N]`) of `reset` resets only these environments. Its other options
    have one row for each environment.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the state is unchanged.
    """

    def __init__(
        self,
        problem: str,
        *,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        action_format: ActionFormat | None = None,
        **settings: Any,
    ) -> None:
        self._problem = NumpyBatchedEnv(problem, (num_envs,), action_format, settings)
        self.num_envs = num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.single_action_space = self._problem.action_space
        self.single_observation_space = self._problem.observation_space
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


def to_numpy(tensor: torch.Tensor) -> np.ndarray:
    """Return a copy of a tensor as an array that shares no memory with it."""
    return tensor.cpu().numpy().copy()
