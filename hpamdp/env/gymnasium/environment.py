"""Any Gymnasium environment with parameterised actions, as one batched TorchRL environment."""

from __future__ import annotations

import copy
import importlib
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import torch
from pydantic import PositiveInt, ValidationError
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded

from hpamdp import keys
from hpamdp.env.actions import check_action_values, invalid_action
from hpamdp.env.base import PAMDPEnv, ProblemError, checked_option_names
from hpamdp.env.gymnasium.action_spaces import ActionSpace, OptionSpace, written
from hpamdp.env.gymnasium.contract import checked
from hpamdp.env.gymnasium.four_value import FourValueEnv
from hpamdp.env.gymnasium.leaves import OutOfBounds
from hpamdp.env.gymnasium.masks import Masks, MaskSource
from hpamdp.env.gymnasium.observation_spaces import ObservationSpace, Scaling
from hpamdp.env.gymnasium.time_limit import with_limit
from hpamdp.env.gymnasium.values import flag
from hpamdp.env.registration import register
from hpamdp.messages import one_line
from hpamdp.settings import SettingError, Settings

_SUCCESS = "success"
# If an info has both entries, the first one counts.
_SUCCESS_ENTRIES = ("is_success", "success")
_SEED = "seed"
# Separate streams of seeds for training and for the fixed episodes of evaluation.
_TRAINING, _FIXED = 0, 1


class GymnasiumOptions(Settings):
    """Settings of `GymnasiumEnv`."""

    id: str | None = None
    """The registered name, as `gymnasium.make` takes it; `module:Name-v0` imports the module, which registers it."""
    entry_point: str | None = None
    """Instead of `id`, a class or function `package.module:name` that returns the environment.

    The environment may have the interface of gym, with four values from `step`; `gym:make` makes environments that are
    registered with gym.
    """
    kwargs: dict[str, Any] | None = None
    """Arguments of the environment's constructor, as in `env.kwargs={size:5}`."""
    max_steps: PositiveInt | None = None
    """Steps after which an episode is truncated. If None, the limit of the `TimeLimit` wrapper or of the spec."""
    parameter_dims: list[int] | None = None
    """How many parameters each discrete action takes of one box for all, as in [1, 1, 0]. If None, the whole box."""
    option_key: int | str | None = None
    """The option's name in a `Dict` of actions or its number in a `Tuple`. If None, the entry `option`, if any."""
    action_mask: MaskSource | None = None
    """Where the environment says which actions it forbids. `info`: `action_mask` and `option_mask` in each info.

    `ignore`: masks are ignored. If None, the entries `action_mask` and `option_mask` of a `Dict` of observations, if it
    has them. A mask in another place, such as a method `action_masks()`, is refused unless masks are ignored.
    """
    observation_keys: list[int | str] | None = None
    """Entries of a `Tuple` or `Dict` to observe, as in [0] or [position, speed]. If None, all but masks."""
    observation_scaling: Scaling = "bounds"
    """`bounds`: to [-1, 1], if the space has bounds; `running`: to mean 0 and standard deviation 1; `none`: not."""
    out_of_bounds: OutOfBounds = "refuse"
    """If a number is outside the bounds of its `Box`, `refuse` ends the run, `clip` moves it, and `allow` keeps it."""


class GymnasiumEnv(PAMDPEnv):
    """`num_envs` copies of a Gymnasium environment, stepped one after another in this process.

    `hpamdp.env.gymnasium.action_spaces` and `hpamdp.env.gymnasium.observation_spaces` tell which spaces are accepted
    and how they are converted. Parameters outside their bounds are clipped; those of the chosen action must be finite.
    A space with an option in it, see there, leaves its choice to the agent; the environment may name its options in an
    attribute `option_names`. The leaf `success` bool `[N]` is `is_success` or `success` in the info of a step, False if
    it has neither.

    A copy's first reset is seeded from `seed` and the copy's number, later resets are not seeded. `reset` also takes
    the seeds to use: a tensordict with `seed` int `[N]`.

    Args:
        num_envs: number of copies.
        options: the settings; None for the defaults.
        device: of the tensors.
        seed: of the episodes, see above.
        first_env: number of the first copy, if other processes have those before it.
        settings: single settings by name, in place of those in `options`.

    Raises:
        ValueError: an argument, a space or an action is invalid; after an invalid action no copy has moved.
        ProblemError: a copy gave what its own spaces do not have.
    """

    Options = GymnasiumOptions
    result_keys = (_SUCCESS,)
    guarded_settings = ("id", "entry_point", "kwargs")

    def __init__(
        self,
        num_envs: int = 1,
        *,
        options: GymnasiumOptions | None = None,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
        **settings: Any,
    ) -> None:
        options = self.options = GymnasiumOptions.of(options, settings)
        # Not a check of the model: the command that resumes a run need not repeat them.
        if (options.id is None) == (options.entry_point is None):
            given = "neither is" if options.id is None else "both are"
            raise SettingError(f"set env.id=Name-v0 or env.entry_point=package.module:name; {given} set")
        register()
        if num_envs < 1:
            raise SettingError(f"GymnasiumEnv: {num_envs=}, but must be at least 1")
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs = num_envs
        self.first_env = first_env
        self._name = f"GymnasiumEnv: {options.entry_point or options.id}"
        self.envs = [self._make() for _ in range(num_envs)]
        self.is_closed = False  # TorchRL's flag: from here on there are copies to close
        self._check_spaces()
        try:
            self.envs, limits = map(list, zip(*[with_limit(env, options.max_steps) for env in self.envs], strict=True))
            self.max_steps = max(limits)
            self._options = OptionSpace(self.envs[0].action_space, options.option_key)
            self._actions = ActionSpace(self._options.rest, options.parameter_dims)
            sizes = {
                keys.ACTION_MASK: len(self._actions.parameter_dims),
                keys.OPTION_MASK: self._options.num_options,
            }
            self._masks = Masks(self.envs[0], num_envs, sizes, options.action_mask)
            observation_keys = options.observation_keys
            if self._masks.in_observation and observation_keys is None:
                space = self.envs[0].observation_space
                observation_keys = [name for name in getattr(space, "spaces", {}) if name not in self._masks.rows]
            self.observations = ObservationSpace(
                self.envs[0].observation_space, options.observation_scaling, observation_keys, options.out_of_bounds
            )
        except ValueError as error:
            raise SettingError(f"{self._name}: {error}") from error
        self.parameter_dims = self._actions.parameter_dims
        self.option_names = self._names_of_options()
        self._make_specs()
        self._observation = np.zeros((num_envs, self.observations.dim), np.float32)
        self._terminated = np.zeros(num_envs, bool)
        self._truncated = np.zeros(num_envs, bool)
        self._success = np.zeros(num_envs, bool)
        self._reports_success = False
        self._set_seed(seed)

    @property
    def is_shardable(self) -> bool:
        """Whether no running statistics are kept, which all environments must share."""
        return self.observations.statistics is None

    @property
    def title(self) -> str:
        """The class and what it was made from."""
        return self._name

    def fixed_episodes(self, seed: int) -> TensorDict:
        """Return seeds to `reset` with, one for each copy, from another stream than those of training."""
        seeds = torch.tensor(_seeds(seed, self.num_envs, _FIXED), device=self.device)
        return TensorDict({_SEED: seeds}, batch_size=self.batch_size, device=self.device)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `success` bool `[M]` if any info so far had it."""
        success = last.get(_SUCCESS)
        # A success in `last` may have been reported to a copy in another process.
        self._reports_success |= bool(success.any())
        return {_SUCCESS: success} if self._reports_success else {}

    def set_scaling_from(self, other: GymnasiumEnv) -> None:
        """Scale observations by the running statistics of `other`, now and later, without updating them.

        Without running statistics this changes nothing.

        Raises:
            ValueError: the two differ in their scaling or in the length of their observations.
        """
        self.observations.share(other.observations)

    @property
    def keeps_episodes(self) -> bool:
        """Whether episodes continue in a resumed run: no, the state of somebody else's environment is unknown."""
        return False

    def env_state(self) -> dict[str, Tensor]:
        """Return the running statistics, if there are any; the state of the episodes is unknown."""
        statistics = self.observations.statistics
        return {} if statistics is None else statistics.columns()

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Continue with saved running statistics; new episodes start.

        Raises:
            ValueError: the statistics are of observations of another length.
        """
        if self.observations.statistics is not None and columns:
            self.observations.statistics.set_columns(columns)

    def statistics(self) -> dict[str, Tensor]:
        """Return the running statistics: they are the whole `env_state`."""
        return self.env_state()

    def set_statistics(self, columns: Mapping[str, Tensor]) -> None:
        """Continue with saved running statistics: they are the whole `env_state`."""
        self.set_env_state(columns)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the copies."""
        if not self.is_closed:
            for env in self.envs:
                env.close()
        super().close(raise_if_closed=raise_if_closed)

    def _make(self) -> gymnasium.Env:
        id, limit = self.options.id, self.options.max_steps
        # The copies of the environment must not share what they may change.
        kwargs = copy.deepcopy(self.options.kwargs or {})
        try:
            if self.options.entry_point is None:
                assert id is not None  # checked by the settings
                return checked(gymnasium.make(id, max_episode_steps=limit, disable_env_checker=True, **kwargs))
            env = self._load(self.options.entry_point)(**kwargs)
        except (gymnasium.error.Error, ImportError) as error:
            raise SettingError(f"{self._name}: {one_line(error)}") from error
        except (TypeError, ValueError) as error:
            cause = error.__cause__ or error  # Gymnasium raises a constructor's error again, from the original one
            if isinstance(cause, ValidationError):  # a class with Options refuses a setting
                wrong = cause.errors()[0]
                given = "".join(f"{name}={wrong['input']}: " for name in wrong["loc"][:1])
                raise SettingError(f"{self._name}: {given}{wrong['msg']}") from error
            # A constructor may pass unknown arguments on to another one, which then raises the error.
            is_unknown = any(f"unexpected keyword argument '{name}'" in str(cause) for name in kwargs)
            if not (is_unknown or _is_about_the_call(cause)):
                raise
            raise SettingError(f"{self._name}: {one_line(cause)}") from error
        if not isinstance(env, gymnasium.Env):
            env = FourValueEnv(env)
        return checked(env)

    def _check_spaces(self) -> None:
        first = self.envs[0]
        for row, env in enumerate(self.envs):
            for name in ("action_space", "observation_space"):
                if getattr(env, name) != getattr(first, name):
                    given, wanted = written(getattr(env, name)), written(getattr(first, name))
                    different = f"the {name} of copy {row} is {given}, but that of copy 0 {wanted}"
                    raise SettingError(f"{self._name}: {different}")

    def _load(self, entry_point: str) -> Any:
        module_name, _, name = entry_point.partition(":")
        if not all(part.isidentifier() for part in (*module_name.split("."), name)):
            raise SettingError(f"{self._name}: must be a class or function, as package.module:name")
        entry = getattr(importlib.import_module(module_name), name, None)
        if not callable(entry):
            raise SettingError(f"{self._name}: there is no class or function {name} in {module_name}")
        return entry

    def _names_of_options(self) -> tuple[str, ...]:
        num_options = self._options.num_options
        given = getattr(self.envs[0].unwrapped, "option_names", ())
        try:
            names = checked_option_names(() if given is None else given)
        except ProblemError as error:
            raise SettingError(f"{self._name}: {error}") from error
        return names if num_options and len(names) == num_options else tuple(f"option{i}" for i in range(num_options))

    def _make_specs(self) -> None:
        n = self.num_envs
        device = self.device
        self.observation_spec = Composite(
            {
                keys.OBSERVATION: Unbounded(shape=(n, self.observations.dim), device=device, dtype=torch.float32),
                _SUCCESS: Categorical(2, shape=(n,), dtype=torch.bool, device=device),
            },
            shape=(n,),
        )
        for name, masks in self._masks.rows.items():
            size = masks.shape[1]
            self.observation_spec[name] = Binary(size, shape=(n, size), dtype=torch.bool, device=device)
        low = torch.from_numpy(self._actions.low)
        high = torch.from_numpy(self._actions.high)
        self.action_spec = self.make_action_spec(low, high, has_option=self._options.num_options > 0)
        self.reward_spec = Unbounded(shape=(n, 1), device=device, dtype=torch.float32)
        self.done_spec = self.make_done_spec()

    def _set_seed(self, seed: int | None) -> None:
        # Of each copy's next reset; None after its first one.
        self._next_seeds: list[int | None] = [
            *_seeds(0 if seed is None else seed, self.num_envs, _TRAINING, self.first_env)
        ]

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        given = None if tensordict is None else tensordict.get(_SEED, None)
        if given is not None and (given.shape != (self.num_envs,) or given.is_floating_point() or (given < 0).any()):
            raise ValueError(f"reset: {_SEED} must be integers of at least 0 in shape [{self.num_envs}]")
        rows = list(range(self.num_envs)) if mask is None else _rows(mask)
        observations = []
        for row in rows:
            seed = self._next_seeds[row] if given is None else given[row].item()
            self._next_seeds[row] = None
            with self._problem_of(row):
                observation, info = self.envs[row].reset(seed=seed)
                self._masks.check_attributes(self.envs[row])
                observations.append(self.observations.flat(observation))
                self._masks.keep(row, observation, info)
        self._keep(rows, observations)
        self._terminated[rows] = False
        self._truncated[rows] = False
        self._success[rows] = False
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.check_action(tensordict)
        check_action_values(tensordict.get(keys.DISCRETE), tensordict.get(keys.PARAMETERS), self.parameter_dims)
        discrete = tensordict.get(keys.DISCRETE).tolist()
        parameters = tensordict.get(keys.PARAMETERS).detach().cpu().numpy()
        options = self._read_options(tensordict)
        is_running = ~(self._terminated | self._truncated)
        if "_step" in tensordict.keys():
            is_running &= np.isin(np.arange(self.num_envs), _rows(tensordict.get("_step")))
        rows = is_running.nonzero()[0].tolist()
        observations = []
        rewards = np.zeros((self.num_envs, 1))
        for row in rows:
            action = self._actions.to_native(discrete[row], parameters[row])
            if options is not None:
                action = self._options.with_option(action, options[row])
            with self._problem_of(row):
                observation, reward, terminated, truncated, info = self.envs[row].step(action)
                observations.append(self.observations.flat(observation))
                self._masks.keep(row, observation, info)
                succeeded = self._read_success(info)
            rewards[row] = reward
            self._terminated[row] = terminated
            self._truncated[row] = truncated and not terminated
            self._success[row] = succeeded
        self._keep(rows, observations)
        return self._read().set(keys.REWARD, torch.from_numpy(rewards).to(self.device, torch.float32))

    def _read_success(self, info: Mapping[str, Any]) -> bool:
        """Return whether the info of a step reports success; False if it has no such entry."""
        for name in _SUCCESS_ENTRIES:
            if name in info:
                self._reports_success = True
                return flag(f"info[{name!r}]", info[name])
        return False

    def _read_options(self, tensordict: TensorDictBase) -> list[int] | None:
        """Return the options, checked; None where the environment itself has none."""
        num_options = self._options.num_options
        if num_options == 0:
            return None
        options = tensordict.get(keys.OPTION).tolist()
        for row, option in enumerate(options):
            if not 0 <= option < num_options:
                raise invalid_action(row, {keys.OPTION: (option, f"allowed 0 to {num_options - 1}")})
        return options

    @contextmanager
    def _problem_of(self, row: int) -> Iterator[None]:
        """Say which copy broke its contract."""
        try:
            yield
        except ProblemError as error:
            raise ProblemError(f"{self._name}: environment {row}: {error}") from error

    def _keep(self, rows: list[int], observations: list[np.ndarray]) -> None:
        """Scale the new observations of these rows and keep them."""
        if observations:
            self._observation[rows] = self.observations.scaled(np.stack(observations))

    def _read(self) -> TensorDict:
        leaves = {
            keys.OBSERVATION: self._observation,
            _SUCCESS: self._success,
            **self._masks.rows,
            keys.TERMINATED: self._terminated[:, None],
            keys.TRUNCATED: self._truncated[:, None],
            keys.DONE: (self._terminated | self._truncated)[:, None],
        }
        # torch.tensor copies, so that the next step does not change what was returned.
        tensors = {name: torch.tensor(leaf, device=self.device) for name, leaf in leaves.items()}
        return self.check_masks(TensorDict(tensors, batch_size=self.batch_size, device=self.device))


def _seeds(seed: int, num: int, stream: int, first: int = 0) -> list[int]:
    """Return 31-bit seeds, which every generator takes, for the `num` copies from number `first` on."""
    rows = range(first, first + num)
    return [int(np.random.SeedSequence((seed, row, stream)).generate_state(1)[0] >> 1) for row in rows]


def _rows(mask: Tensor) -> list[int]:
    """Return the rows of a mask `[N]` or `[N, 1]` that are True."""
    return mask.reshape(-1).nonzero().squeeze(-1).tolist()


def _is_about_the_call(error: BaseException) -> bool:
    """Return whether an error is about a call's arguments or a registered time limit: raised here or in Gymnasium."""
    frame, _ = list(traceback.walk_tb(error.__traceback__))[-1]
    return frame.f_globals["__name__"] in (__name__, "gymnasium.envs.registration", "gymnasium.wrappers.common")
