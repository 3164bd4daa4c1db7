"""Gymnasium environments of any `BatchedEnv`, whose id a problem registers with the path of its class.

Their actions are the field's nested tuples, `(discrete action, (parameters of action 0, ..., of action K-1))`. If the
agent chooses an option, it comes first. Batched spaces are Gymnasium's own: every leaf has a leading `[N]`. Only the
parameters of the chosen action count.

Infos:
- always: `outcome` (its name) and `steps` (actions so far);
- in sessions of trips: `trip_ended`;
- if the problem forbids something: its masks;
- once the episode is over: those of `BatchedEnv.final_infos`, such as `is_success`.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from tensordict import TensorDict, TensorDictBase

from hpamdp import keys
from hpamdp.env.batched_env import GOING_ON, BatchedEnv
from hpamdp.env.errors import ProblemError
from hpamdp.env.gymnasium_adapter import (
    After,
    GymnasiumAdapter,
    GymnasiumVectorAdapter,
    NumpyRows,
    RenderMode,
)
from hpamdp.env.gymnasium_checks import describe, parameter_arrays
from hpamdp.env.gymnasium_form import VectorForm
from hpamdp.env.kernel_rows import KernelRows, Results
from hpamdp.env.kernels import OUTCOME_ROW, STEPS_ROW
from hpamdp.settings import SettingError


class BatchedEnvAdapter(GymnasiumAdapter):
    """One environment of a `BatchedEnv`.

    Args:
        problem: the environment's class as text, `package.module:Class`.
        render_mode: None or `rgb_array`.
        settings: what the class takes besides.
    """

    def __init__(self, problem: str, *, render_mode: RenderMode = None, **settings: Any) -> None:
        if "num_envs" in settings:
            raise SettingError(f"num_envs={settings['num_envs']}: this is one environment; use gymnasium.make_vec")
        _refuse_seed(settings)
        env = _load(problem)(1, **settings)
        if render_mode is not None and type(env).draw is BatchedEnv.draw:
            raise SettingError(f"render_mode={render_mode!r}: {env.title} has no pictures")
        super().__init__(NumpyBatchedEnv(env, ()), render_mode)
        self._env = env
        self.own_time_limit = env.max_steps
        self.training_begins_elsewhere = env.training_begins_elsewhere

    def _draw(self) -> np.ndarray:
        return self._env.draw(self._track)


class BatchedEnvVectorAdapter(GymnasiumVectorAdapter):
    """`num_envs` environments of a `BatchedEnv`.

    Args:
        problem: the environment's class as text, `package.module:Class`.
        num_envs, autoreset_mode: as in `GymnasiumVectorAdapter`.
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
        _refuse_seed(settings)
        env = _load(problem)(num_envs, **settings)
        super().__init__(NumpyBatchedEnv(env, (num_envs,)), num_envs, autoreset_mode)


class TensorRows:
    """The methods of `KernelRows`, for a `BatchedEnv` that its tensor functions move."""

    def __init__(self, env: BatchedEnv) -> None:
        self._env = env

    @property
    def floats(self) -> np.ndarray:
        """The float32 columns of the state."""
        return np.stack([to_numpy(column) for column in self._env.state if column.is_floating_point()])

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


def rows_of(env: BatchedEnv) -> KernelRows | TensorRows:
    """Return what moves the rows of an environment."""
    return TensorRows(env) if env.rows is None else env.rows


class NumpyBatchedEnv(NumpyRows):
    """A `BatchedEnv` with NumPy in and out: one environment (`batch=()`) or many (`batch=(N,)`)."""

    def __init__(self, env: BatchedEnv, batch: tuple[int, ...]) -> None:
        if not env.components.is_single or any(env.integer_parameters):
            raise ProblemError(f"{env.title}: the Gymnasium form of a BatchedEnv has one component of real parameters")
        super().__init__(rows_of(env), batch)
        self.action_space = VectorForm(env).action_space
        self._env = env
        self._picture = env.observation_entries[0].shape if env.observation_entries else None
        if self._picture is None:
            low, high = (np.array(side, np.float32) for side in env.observation_bounds)
            self.observation_space = spaces.Box(low, high, dtype=np.float32)
        else:
            pixels: Any = np.uint8  # the annotation of Box knows float32 alone
            self.observation_space = spaces.Box(0, 255, self._picture, pixels)
        self._outcome_names = np.array(env.outcomes, dtype=object)
        self.final_infos = tuple(env.final_infos(self.rows))
        self._num_options = len(env.option_names) if env.has_choice else 0

    @property
    def state(self) -> Any:
        """The columns of the state."""
        return self._env.state

    def reset(self, seed: int | None, options: Mapping[str, Any] | None, mask: np.ndarray | None = None) -> np.ndarray:
        """Start new episodes, in the rows of `mask` or in all, and return the observations `[N, ...]`."""
        return self._shown(super().reset(seed, options, mask))

    def step(self, action: Any, *, restarts: bool = False) -> After:
        """Return what follows an action in every environment."""
        after = super().step(action, restarts=restarts)
        if self._env.limit_terminates:
            ended = after.terminations | after.truncations
            after = after._replace(terminations=ended, truncations=np.zeros_like(ended))
        return after if self._picture is None else after._replace(observations=self._shown(after.observations))

    def _shown(self, observations: np.ndarray) -> np.ndarray:
        """Return the pictures `[N, *shape]` of vectors, if the problem shows pictures."""
        if self._picture is None:
            return observations
        if self._env.rows is not None:  # the tensor functions have drawn them already
            observations = self._env.shown(torch.from_numpy(observations)).numpy()
        return observations.reshape(-1, *self._picture)

    def _invalid(self, row: int, leaves: tuple[Any, Any, Any]) -> ValueError:
        return self._env.invalid_action(row, leaves)

    def infos(self) -> dict[str, np.ndarray]:
        """Return the infos, `[N]` each."""
        steps, outcome = self.rows.integers[STEPS_ROW], self.rows.integers[OUTCOME_ROW]
        infos = {"outcome": self._outcome_names[outcome], "steps": steps.astype(np.int64)}
        if self._env.card.has_trips:
            infos[keys.TRIP_ENDED] = self._env.trip_ends(self.rows)
        return infos | self._masks() | self._env.final_infos(self.rows)

    def _masks(self) -> dict[str, np.ndarray]:
        return {name: to_numpy(mask) for name, mask in self._env.masks().items()}

    def info(self) -> dict[str, Any]:
        """Return the infos of the first environment as Python's numbers."""
        steps, outcome, _ = self.rows.integers[STEPS_ROW:, 0].tolist()
        values: dict[str, Any] = {"outcome": self._env.outcomes[outcome], "steps": steps}
        if self._env.card.has_trips:
            values[keys.TRIP_ENDED] = self._env.trip_ends(self.rows).item(0)
        values |= {name: mask[0] for name, mask in self._masks().items()}
        if outcome == GOING_ON:
            return values
        return values | {name: value.item(0) for name, value in self._env.final_infos(self.rows).items()}

    def _leaves(self, action: Any) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
        """Check an action's structure, types and shapes; return options, discrete actions and parameters."""
        names = ("option", "discrete", "parameters") if self._num_options else ("discrete", "parameters")
        if not isinstance(action, (tuple, list)) or len(action) != len(names):
            raise ValueError(f"step: the action must be a tuple ({', '.join(names)}), but is {describe(action)}")
        *options, discrete, parameters = action
        dims = self._env.parameter_dims
        arrays = parameter_arrays(parameters, dims, self._batch)
        joined = np.empty((self._env.num_envs, sum(dims)), np.float32)
        np.concatenate(arrays, axis=-1, out=joined if self._batch else joined[0], casting="same_kind")
        option = self._integers("option", options[0]) if options else None
        return option, self._integers("discrete", discrete), joined


def _refuse_seed(settings: Mapping[str, Any]) -> None:
    """Refuse the seed that a `BatchedEnv` takes, since resets seed a Gymnasium environment.

    Raises:
        SettingError: there is one.
    """
    if "seed" in settings:
        raise SettingError(f"seed={settings['seed']}: no setting of the environment; give it to reset")


def _load(problem: str) -> type[Any]:
    """Return the class that `package.module:Class` names."""
    module, _, name = problem.partition(":")
    return getattr(importlib.import_module(module), name)


def to_numpy(tensor: torch.Tensor) -> np.ndarray:
    """Return a copy of a tensor as an array that shares no memory with it."""
    return tensor.cpu().numpy().copy()
