"""The way in: other people's Gymnasium environments with parameterised actions, as one batched TorchRL environment."""

from __future__ import annotations

import copy
import importlib
import traceback
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical, Composite, Unbounded

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.gymnasium.action_spaces import ActionSpace
from hpamdp.env.gymnasium.four_value import FourValueEnv
from hpamdp.env.gymnasium.observation_spaces import ObservationSpace, Scaling

_SUCCESS, _SEED = "success", "seed"
# The seeds of training and of evaluation's fixed episodes come from streams of their own.
_TRAINING, _FIXED = 0, 1


class GymnasiumEnv(PAMDPEnv):
    """Play `num_envs` copies of a Gymnasium environment, one after another in this process.

    Which spaces are accepted, and what becomes of them, is told in `hpamdp.env.gymnasium.action_spaces` and
    `hpamdp.env.gymnasium.observation_spaces`. Parameters outside their bounds are clipped; the pressed key's must be finite. The
    leaf `success` bool `[N]` is what a step's info says under `is_success` or `success`, False if it says nothing.

    A copy's first reset has a seed made from `seed` and the copy's number, those that follow have none. `reset` also
    takes the seeds to use: a tensordict with `seed` int `[N]`.

    Args:
        num_envs: how many copies.
        id: as `gymnasium.make` takes it; with `module:Name-v0` the module, which registers the name, is imported.
        entry_point: instead of `id`, a class or function, `package.module:name`, that gives the environment. One that
            is no `gymnasium.Env` is taken to have the old four-value interface of `gym`: see `FourValueEnv`.
        kwargs: what the environment is made with.
        max_steps: episodes are truncated after that many steps; None: by the environment's own time limit.
        parameter_dims: how many parameters each key takes of one box for all keys; None: each takes the whole box.
        observation_scaling: `bounds`, `running` or `none`: see `ObservationSpace`.
        device: where the tensors live.
        seed: see above.
        first_env: number of the first copy, where other processes have those before.

    Raises:
        ValueError: an argument, a space or an action that cannot be; after such an action no copy has moved.
    """

    result_keys = (_SUCCESS,)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        id: str | None = None,
        entry_point: str | None = None,
        kwargs: dict[str, Any] | None = None,
        max_steps: int | None = None,
        parameter_dims: list[int] | None = None,
        observation_scaling: Scaling = "bounds",
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
    ) -> None:
        _check_arguments(num_envs, id, entry_point, max_steps)
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs, self.first_env = num_envs, first_env
        self._name = f"GymnasiumEnv: {id if entry_point is None else entry_point}"
        self.envs = [self._make(id, entry_point, kwargs or {}, max_steps) for _ in range(num_envs)]
        self.is_closed = False  # from here on there is something to close
        limit = getattr(self.envs[0].spec, "max_episode_steps", None) if max_steps is None else max_steps
        if limit is None:
            raise ValueError(f"{self._name}: has no time limit of its own; set env.max_steps")
        self.max_steps = limit
        try:
            self._actions = ActionSpace(self.envs[0].action_space, parameter_dims)
            self.observations = ObservationSpace(self.envs[0].observation_space, observation_scaling)
        except ValueError as error:
            raise ValueError(f"{self._name}: {error}") from error
        self.parameter_dims = self._actions.parameter_dims
        self._make_specs()
        self._seen = np.zeros((num_envs, self.observations.dim), np.float32)
        self._terminated, self._truncated, self._success = np.zeros((3, num_envs), bool)
        self._tells_success = False
        self._set_seed(seed)

    @property
    def is_shardable(self) -> bool:
        """Whether no running statistics are kept."""
        return self.observations.statistics is None

    def fixed_episodes(self, seed: int) -> TensorDict:
        """Return seeds to `reset` with, one for each copy, other than those with which training begins."""
        seeds = torch.tensor(_seeds(seed, self.num_envs, _FIXED), device=self.device)
        return TensorDict({_SEED: seeds}, batch_size=self.batch_size, device=self.device)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `success` bool `[M]`, if the info of any step so far told it."""
        self._tells_success |= bool(last.get(_SUCCESS).any())  # steps in another process
        return {_SUCCESS: last.get(_SUCCESS)} if self._tells_success else {}

    def set_scaling_from(self, other: GymnasiumEnv) -> None:
        """Scale observations by the running statistics of `other`, now and in future, and add nothing to them.

        Without running statistics that changes nothing.

        Raises:
            ValueError: the two scale differently, or have other observations.
        """
        self.observations.share(other.observations)

    def env_state(self) -> dict[str, Tensor]:
        """Return the running statistics, if there are some; where episodes stand cannot be had."""
        statistics = self.observations.statistics
        return {} if statistics is None else statistics.columns()

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Go on with running statistics; episodes start anew.

        Raises:
            ValueError: they are of other observations.
        """
        if self.observations.statistics is not None and columns:
            self.observations.statistics.set_columns(columns)

    def set_statistics(self, columns: Mapping[str, Tensor]) -> None:
        """Take saved running statistics, which are all that the state columns are."""
        self.set_env_state(columns)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the copies."""
        if not self.is_closed:
            for env in self.envs:
                env.close()
        super().close(raise_if_closed=raise_if_closed)

    def _make(
        self, id: str | None, entry_point: str | None, kwargs: Mapping[str, Any], max_steps: int | None
    ) -> gymnasium.Env:
        kwargs = copy.deepcopy(dict(kwargs))  # no copy of the environment may change another's
        try:
            if entry_point is None:
                return gymnasium.make(id, max_episode_steps=max_steps, disable_env_checker=True, **kwargs)
            env = self._load(entry_point)(**kwargs)
        except (gymnasium.error.Error, ImportError) as error:
            raise ValueError(f"{self._name}: {_one_line(error)}") from error
        except TypeError as error:
            cause = error.__cause__ or error  # Gymnasium raises what a constructor raises anew
            if not _is_about_the_call(cause):
                raise
            raise ValueError(f"{self._name}: {_one_line(cause)}") from error
        env = env if isinstance(env, gymnasium.Env) else FourValueEnv(env)
        return env if max_steps is None else gymnasium.wrappers.TimeLimit(env, max_steps)

    def _load(self, entry_point: str) -> Any:
        module_name, _, name = entry_point.partition(":")
        if not all(part.isidentifier() for part in (*module_name.split("."), name)):
            raise ValueError(f"{self._name}: must be a class or function, as package.module:name")
        made = getattr(importlib.import_module(module_name), name, None)
        if not callable(made):
            raise ValueError(f"{self._name}: there is no class or function {name} in {module_name}")
        return made

    def _make_specs(self) -> None:
        n, device = self.num_envs, self.device
        self.observation_spec = Composite(
            {
                keys.OBSERVATION: Unbounded(shape=(n, self.observations.dim), device=device),
                _SUCCESS: Categorical(2, shape=(n,), dtype=torch.bool, device=device),
            },
            shape=(n,),
        )
        self.action_spec = self.make_action_spec(*map(torch.from_numpy, (self._actions.low, self._actions.high)))
        self.reward_spec = Unbounded(shape=(n, 1), device=device)
        self.done_spec = self.make_done_spec()

    def _set_seed(self, seed: int | None) -> None:
        self._next_seeds: list[int | None] = [
            *_seeds(0 if seed is None else seed, self.num_envs, _TRAINING, self.first_env)
        ]

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        given = None if tensordict is None else tensordict.get(_SEED, None)
        if given is not None and (given.shape != (self.num_envs,) or given.is_floating_point() or (given < 0).any()):
            raise ValueError(f"reset: {_SEED} must be integers of at least 0 in shape [{self.num_envs}]")
        rows, seen = np.arange(self.num_envs) if mask is None else _rows(mask), []
        for row in rows:
            seed = self._next_seeds[row] if given is None else given[row].item()
            self._next_seeds[row] = None
            seen.append(self._flat(row, self.envs[row].reset(seed=seed)[0]))
        self._keep(rows, seen)
        for flags in (self._terminated, self._truncated, self._success):
            flags[rows] = False
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        pressed, parameters = self._checked_action(tensordict)
        is_on = ~(self._terminated | self._truncated)
        if "_step" in tensordict.keys():
            is_on &= np.isin(np.arange(self.num_envs), _rows(tensordict.get("_step")))
        rows, seen, rewards = is_on.nonzero()[0], [], np.zeros((self.num_envs, 1), np.float32)
        for row in rows:
            action = self._actions.to_native(int(pressed[row]), parameters[row])
            observation, reward, terminated, truncated, info = self.envs[row].step(action)
            seen.append(self._flat(row, observation))
            rewards[row] = np.asarray(reward).item()
            self._terminated[row], self._truncated[row] = terminated, truncated and not terminated
            told = info.get("is_success", info.get(_SUCCESS))
            self._tells_success |= told is not None
            self._success[row] = bool(told)
        self._keep(rows, seen)
        return self._read().set(keys.REWARD, torch.from_numpy(rewards).to(self.device))

    def _checked_action(self, tensordict: TensorDictBase) -> tuple[np.ndarray, np.ndarray]:
        """Return the keys `[N]` and the parameters `[N, num_parameters]`."""
        self.check_action(tensordict)
        dims = self.parameter_dims
        pressed, parameters = (tensordict.get(name).detach().cpu().numpy() for name in (keys.DISCRETE, keys.PARAMETERS))
        is_own = np.repeat(np.arange(len(dims)), dims) == pressed[:, None]
        is_action = (pressed >= 0) & (pressed < len(dims)) & (np.isfinite(parameters) | ~is_own).all(-1)
        if not is_action.all():
            row = (~is_action).nonzero()[0][0]
            raise ValueError(
                f"step: environment {row} got discrete={pressed[row]} (allowed 0 to {len(dims) - 1}), "
                f"parameters={parameters[row].tolist()} (the pressed key's must be finite)"
            )
        return pressed, parameters

    def _flat(self, row: int, observation: Any) -> np.ndarray:
        try:
            return self.observations.flat(observation)
        except ValueError as error:
            raise ValueError(f"{self._name}: environment {row}: {error}") from error

    def _keep(self, rows: np.ndarray, seen: list[np.ndarray]) -> None:
        if seen:
            self._seen[rows] = self.observations.scaled(np.stack(seen))

    def _read(self) -> TensorDict:
        flags = {keys.TERMINATED: self._terminated, keys.TRUNCATED: self._truncated}
        flags[keys.DONE] = self._terminated | self._truncated
        leaves = {keys.OBSERVATION: self._seen, _SUCCESS: self._success}
        leaves |= {name: flag[:, None] for name, flag in flags.items()}
        # Copies, so that the next step changes nothing that was returned.
        tensors = {name: torch.tensor(leaf, device=self.device) for name, leaf in leaves.items()}
        return TensorDict(tensors, batch_size=self.batch_size, device=self.device)


def _check_arguments(num_envs: int, id: str | None, entry_point: str | None, max_steps: int | None) -> None:
    if num_envs < 1:
        raise ValueError(f"GymnasiumEnv: num_envs={num_envs}, but must be at least 1")
    if (id is None) == (entry_point is None):
        given = "neither is" if id is None else "both are"
        raise ValueError(f"GymnasiumEnv: set env.id=Name-v0 or env.entry_point=package.module:name; {given} set")
    if max_steps is not None and max_steps < 1:
        raise ValueError(f"GymnasiumEnv: max_steps={max_steps}, but must be at least 1 or null")


def _seeds(seed: int, num: int, stream: int, first: int = 0) -> list[int]:
    """Return a seed for each of `num` copies from number `first` on, in 31 bits, which every generator takes."""
    rows = range(first, first + num)
    return [int(np.random.SeedSequence((seed, row, stream)).generate_state(1)[0] >> 1) for row in rows]


def _rows(mask: Tensor) -> np.ndarray:
    return mask.reshape(-1).nonzero().squeeze(-1).cpu().numpy()


def _is_about_the_call(error: BaseException) -> bool:
    """Return whether an error is about the arguments of a call from here or from Gymnasium, not from deeper inside."""
    frame, _ = list(traceback.walk_tb(error.__traceback__))[-1]
    return frame.f_globals["__name__"] in (__name__, "gymnasium.envs.registration")


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
