"""Gymnasium environments of any `CounterEnv`, whose id a problem registers with the path of its class.

Their actions are the field's nested tuples, `(discrete action, (parameters of action 0, ..., of action K-1))`; batched
spaces are Gymnasium's own: every leaf has a leading `[N]`. Only the parameters of the chosen action count.

Infos: `outcome` (name), `steps` (actions so far) and, once the episode is over, `is_success`.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.counter_env import GOING_ON, SUCCESS, CounterEnv
from hpamdp.env.gymnasium_adapter import (
    After,
    GymnasiumAdapter,
    GymnasiumVectorAdapter,
    NumpyEnv,
    RenderMode,
    as_array,
    describe,
)
from hpamdp.env.kernels import OUTCOME_ROW, STEPS_ROW


class CounterAdapter(GymnasiumAdapter):
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


class CounterVectorAdapter(GymnasiumVectorAdapter):
    """`num_envs` environments of a `CounterEnv`.

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
        self._outcome_names = np.array(env.outcomes, dtype=object)

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
        self.is_reset = True
        if self._env.rows is not None:
            return self._env.rows.restart(mask).observations[0]
        given = TensorDict(batch_size=self._env.batch_size, device=self._env.device)
        if mask is not None:
            given["_reset"] = torch.from_numpy(mask.copy()).to(self._env.device).unsqueeze(-1)
        return to_numpy(self._env.reset(given)[keys.OBSERVATION])

    def step(self, action: Any, *, restarts: bool = False) -> After:
        """Return what follows an action in every environment."""
        if not self.is_reset:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        given, joined = self._leaves(action)
        if self._env.rows is not None:
            act = self._env.rows.act_or_restart if restarts else self._env.rows.act
            results = act(given, joined)
            if not isinstance(results, int):
                return After(results.observations[0], results.rewards, results.flags[0, 1], results.flags[0, 2])
        discrete, parameters = torch.from_numpy(given), torch.from_numpy(joined)
        over = self._env.state.outcome != GOING_ON
        restarts = restarts and bool(over.any())
        if restarts:
            discrete[over.cpu()] = 0
            parameters[over.cpu()] = 0.0
        td = TensorDict(batch_size=self._env.batch_size, device=self._env.device)
        td[keys.DISCRETE] = discrete
        td[keys.PARAMETERS] = parameters
        after = self._env.step(td)["next"]
        observations, flags = after[keys.OBSERVATION], (after[keys.TERMINATED], after[keys.TRUNCATED])
        if restarts:
            # Finished episodes stayed as they were and earned 0, so only the other results of their rows change.
            observations = self._env.reset(td.empty().set("_reset", over.unsqueeze(-1)))[keys.OBSERVATION]
            flags = tuple(flag & ~over.unsqueeze(-1) for flag in flags)
        return After(to_numpy(observations), *(to_numpy(column)[:, 0] for column in (after[keys.REWARD], *flags)))

    @property
    def is_over(self) -> np.ndarray:
        """Which episodes are over, bool `[N]`."""
        return self._integers()[1] != GOING_ON

    def _integers(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the counts of steps and the outcomes, `[N]` each."""
        if self._env.rows is not None:
            return self._env.rows.integers[STEPS_ROW], self._env.rows.integers[OUTCOME_ROW]
        return to_numpy(self._env.state.steps), to_numpy(self._env.state.outcome)

    def infos(self) -> dict[str, np.ndarray]:
        """Return the infos, `[N]` each."""
        steps, outcome = self._integers()
        return {
            "outcome": self._outcome_names[outcome],
            "steps": steps.astype(np.int64),
            "is_success": outcome == SUCCESS,
        }

    def info(self) -> dict[str, Any]:
        """Return the infos of the first environment as Python's numbers."""
        steps, outcome = (int(column[0]) for column in self._integers())
        values = {"outcome": self._env.outcomes[outcome], "steps": steps}
        return values if outcome == GOING_ON else {**values, "is_success": outcome == SUCCESS}

    def _leaves(self, action: Any) -> tuple[np.ndarray, np.ndarray]:
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
        joined = np.empty((self._env.num_envs, sum(dims)), np.float32)
        np.concatenate(arrays, axis=-1, out=joined if self._batch else joined[0], casting="same_kind")
        return given.reshape(self._env.num_envs), joined


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


def to_numpy(tensor: torch.Tensor) -> np.ndarray:
    """Return a copy of a tensor as an array that shares no memory with it."""
    return tensor.cpu().numpy().copy()
