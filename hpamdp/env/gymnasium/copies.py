"""Copies of a Gymnasium environment, stepped one after another, and what they return."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NoReturn

import gymnasium
import numpy as np

from hpamdp import keys
from hpamdp.env.errors import EnvironmentFaultError, ProblemError, closed_on_error, fault_of
from hpamdp.env.gymnasium.action_spaces import ActionSpace, OptionSpace, written
from hpamdp.env.gymnasium.contract import ContractCheck, checked_step, refuse_running_statistics, refuse_step
from hpamdp.env.gymnasium.making import Maker
from hpamdp.env.gymnasium.masks import Masks
from hpamdp.env.gymnasium.observation_spaces import ObservationSpace
from hpamdp.env.gymnasium.options import GymnasiumOptions
from hpamdp.env.gymnasium.parameter_bounds import ParameterBounds
from hpamdp.env.gymnasium.time_limit import limit_of
from hpamdp.env.gymnasium.values import flag
from hpamdp.messages import warn_once
from hpamdp.settings import SettingError

# If an info has both entries, the first one counts.
_SUCCESS_ENTRIES = ("is_success", "success")
_ALL = slice(None)  # rows
_SPACES = ("action_space", "observation_space")
_PICTURES_PER_SECOND = 4.0
# An environment that names no time limit must end an episode of random actions within so many steps.
_TRIED_STEPS = 1_000
# Then its episodes are truncated after so many steps.
_MOST_STEPS = 10_000


@dataclass(frozen=True)
class Results:
    """What the copies have last returned, with a row for each copy.

    Attributes:
        observation: float64 `[N, dim]`, flattened but not scaled, without pictures.
        reward: float64 `[N]`.
        flags: whether the episode terminated, whether it was truncated, its success, and whether the last info had one,
            bool `[N, 4]`.
        masks: by name, bool `[N, K]`.
        bounds: the parameters' lower and upper bounds in the space's own numbers, float64 `[N, num_parameters]` each;
            None if the bounds do not depend on the state.
        pixels: of all pictures, uint8 `[N, num_pixels]`.
    """

    observation: np.ndarray
    reward: np.ndarray
    flags: np.ndarray
    masks: dict[str, np.ndarray]
    bounds: tuple[np.ndarray, np.ndarray] | None
    pixels: np.ndarray

    @property
    def num_bounded(self) -> int:
        """Number of parameters whose bounds depend on the state."""
        return 0 if self.bounds is None else self.bounds[0].shape[1]

    def arrays(self) -> list[np.ndarray]:
        """Return all arrays, in an order that depends on nothing but the spaces."""
        return [self.observation, self.reward, self.flags, *self.masks.values(), *(self.bounds or ()), self.pixels]

    def changed(self, change: Callable[[np.ndarray], np.ndarray]) -> Results:
        """Return results of which every array is changed."""
        observation, reward, flags, *others, pixels = map(change, self.arrays())
        masks = dict(zip(self.masks, others, strict=False))
        bounds = None if self.bounds is None else (others[-2], others[-1])
        return Results(observation, reward, flags, masks, bounds, pixels)


class Copies:
    """Copies of one environment.

    Args:
        make: makes a copy.
        num: number of copies.
        settings: how its spaces are read.
        flattens_pictures: whether pictures are part of the vectors.
        first: number of the first copy in errors.

    Attributes:
        envs: the copies.
        example: one of them, to read its spaces.
        max_steps: of the longest episode.
        has_pictures: whether `pictures` returns some: the `render_mode` is `rgb_array`.
        pictures_per_second: `render_fps` of the environment's metadata, or 4.
        option_names: what the environment calls its options, unchecked.
        first_info: of a reset; which masks and bounds are in it tells which ones to read.
        results: what the copies have last returned.

    Raises:
        SettingError: the spaces are not accepted, or differ between copies.
        EnvironmentFaultError: a constructor raised an error.
    """

    def __init__(
        self, make: Maker, num: int, settings: GymnasiumOptions, flattens_pictures: bool = False, first: int = 0
    ) -> None:
        self._name = make.name
        self._first = first
        self.envs: list[gymnasium.Env] = []
        with closed_on_error(self):
            for _ in range(num):
                self.envs.append(make())
            self._read(num, settings, flattens_pictures)

    def _read(self, num: int, settings: GymnasiumOptions, flattens_pictures: bool) -> None:
        """Read the spaces, and set up what each step needs."""
        self._check_spaces()
        self.first_info = self._first_info()
        try:
            self.example = self.envs[0]
            if getattr(self.example.unwrapped, "training_begins_elsewhere", False):  # of this package's problems
                raise SettingError(
                    "its training begins elsewhere than its evaluation, or in another world, and a Gymnasium "
                    "environment does not know which of the two it is in; use the problem itself, such as env=pinball"
                )
            refuse_running_statistics(self.example)
            limits = [limit_of(env, settings.max_steps) for env in self.envs]
            self._limits = [_MOST_STEPS if limit is None else limit for limit in limits]
            self.max_steps = max(self._limits)
            space = self.envs[0].observation_space
            self.options = OptionSpace(self.envs[0].action_space, settings.option_key)
            self.actions = ActionSpace(self.options.rest, settings.parameter_dims, settings.action_form)
            sources = settings.action_mask, settings.pair_mask
            self._masks = Masks(self.envs[0], num, self.actions, self.options.num_options, self.first_info, *sources)
            self._bounds = ParameterBounds(self.envs[0], num, self.actions, self.first_info, settings.parameter_bounds)
            entries: Sequence[int | str] | None = settings.observation_keys
            apart = {*self._masks.in_observation, *(self._bounds.names if self._bounds.in_observation else ())}
            if apart and entries is None:
                entries = [entry for entry in getattr(space, "spaces", {}) if entry not in apart]
            self.observations = ObservationSpace(
                space, entries, settings.out_of_bounds, flattens_pictures=flattens_pictures
            )
        except ValueError as error:
            raise SettingError(f"{self._name}: {error}") from error
        self.option_names = getattr(self.envs[0].unwrapped, "option_names", ())
        self.has_pictures = self.envs[0].render_mode == "rgb_array"
        self.pictures_per_second = _rate_of(self.envs[0])
        self.results = Results(
            np.zeros((num, self.observations.dim)),
            np.zeros(num),
            np.zeros((num, 4), bool),
            self._masks.rows,
            (self._bounds.low, self._bounds.high) if self._bounds.names else None,
            np.zeros((num, self.observations.num_pixels), np.uint8),
        )
        # What each step needs, looked up once.
        # Without the outer check, whose work `step` does in its loop.
        self._inner = [env.env if isinstance(env, ContractCheck) else env for env in self.envs]
        self._num_steps = [0] * num
        self._spaces = [(env.action_space, env.observation_space) for env in self.envs]
        self._reads_infos = bool(self._masks.rows or self._bounds.names)
        self._names_no_limit = None in limits

    @cached_property
    def usual_length(self) -> int:
        """The time limit in steps; if the environment names none, those of an episode of random actions.

        Raises:
            SettingError: the episode goes on.
        """
        if not self._names_no_limit:
            return self.max_steps
        rng, actions, num = np.random.default_rng(0), self.actions, len(self.envs)
        self.reset({0: 0})
        for step in range(1, _TRIED_STEPS + 1):
            allowed = {name: rows[0] for name, rows in self.results.masks.items()}
            mask = allowed.get(keys.ACTION_MASK, np.ones(len(actions.parameter_dims), bool))
            parts = np.split(mask, np.cumsum(actions.component_sizes[:-1], dtype=np.int64))
            options = allowed.get(keys.OPTION_MASK, np.ones(max(1, self.options.num_options), bool))
            if keys.PAIR_MASK in allowed or not all(part.any() for part in (*parts, options)):
                break  # components drawn apart may be forbidden, or everything is
            chosen = np.array([rng.choice(np.flatnonzero(part)) for part in parts])
            option = np.full(num, rng.choice(np.flatnonzero(options))) if self.options.num_options else None
            discrete = np.tile(chosen, (num, 1))
            parameters = np.tile(rng.uniform(actions.low, actions.high).astype(np.float32), (num, 1))
            self.step([0], option, discrete if actions.component_sizes else discrete[:, 0], parameters)
            terminated, truncated = self.results.flags[0, :2]
            if terminated:  # with other actions it may go on for longer
                end = f"episodes are truncated after {_MOST_STEPS:,} steps"
                warn_once(f"{self._name}: names no time limit, so {end}; see env.max_steps")
            if terminated or truncated:
                return step
        raise SettingError(f"{self._name}: has no time limit of its own; set env.max_steps")

    def _first_info(self) -> Mapping[str, Any]:
        """Return the info of a reset, which may hold masks and bounds; nothing for the problems of this package."""
        if getattr(self.envs[0].unwrapped, "own_time_limit", None) is not None:
            return {}
        self._row = 0
        try:
            return self.envs[0].reset(seed=0)[1]
        except Exception as error:
            self._explain("reset", error)

    def _check_spaces(self) -> None:
        if len({id(env.unwrapped) for env in self.envs}) < len(self.envs):
            raise SettingError(f"{self._name}: made the same environment twice; each call must make a new one")
        first = self.envs[0]
        for row, env in enumerate(self.envs):
            for name in _SPACES:
                if getattr(env, name) != getattr(first, name):
                    given, wanted = written(getattr(env, name)), written(getattr(first, name))
                    different = f"the {name} of copy {row} is {given}, but that of copy 0 {wanted}"
                    raise SettingError(f"{self._name}: {different}")

    def _check_unchanged(self, row: int) -> None:
        """Check that a copy has the spaces that were read, now and then, since no step can afford it.

        Raises:
            ProblemError: a space depends on the state.
        """
        env = self.envs[row]
        for name, now, read in zip(_SPACES, (env.action_space, env.observation_space), self._spaces[row], strict=True):
            if now is not read and now != read:
                raise ProblemError(
                    f"its {name} was {written(read)} and is now {written(now)}, but must stay the same; give what a "
                    "state forbids as action_mask, its bounds as parameter_low and parameter_high; see env.action_mask"
                )

    def reset(self, seeds: Mapping[int, int | None]) -> None:
        """Begin episodes.

        Args:
            seeds: for the number of each copy to reset its seed, or None.

        Raises:
            ProblemError: a copy broke its contract.
            EnvironmentFaultError: its `reset` raised an error.
        """
        rows, seen = [*seeds], []
        try:
            for self._row, seed in seeds.items():
                env = self.envs[self._row]
                observation, info = env.reset(seed=seed)
                self._check_unchanged(self._row)
                seen.append(observation)
                self._masks.keep(self._row, observation, info)
                self._bounds.keep(self._row, observation, info)
                self._num_steps[self._row] = 0
            if rows:
                self._settle(rows, rows, seen)
        except Exception as error:
            self._explain("reset", error)
        self.results.reward[rows], self.results.flags[rows] = 0.0, False

    def step(self, rows: list[int], option: np.ndarray | None, discrete: np.ndarray, parameters: np.ndarray) -> None:
        """Take a step with some copies.

        Args:
            rows: numbers of these copies.
            option: of all copies, `[N]`; None if the environment has no options.
            discrete: of all copies, `[N]`, or `[N, num_components]`.
            parameters: of all copies, `[N, num_parameters]`.

        Raises:
            ProblemError: a copy broke its contract.
            EnvironmentFaultError: its `step` raised an error.
        """
        index: Any = _ALL if len(rows) == len(self.envs) else rows
        natives = self._natives(index, option, discrete, parameters)
        envs, num_steps, limits = self._inner, self._num_steps, self._limits
        rewards: list[float] = []
        flags: dict[int, tuple[bool, ...]] = {}  # of the few copies that have one
        seen: list[Any] = []
        try:
            for row, action in zip(rows, natives, strict=True):
                self._row = row
                try:
                    values = envs[row].step(action)
                except TypeError as error:
                    refuse_step(error)
                    raise
                observation, reward, terminated, truncated, info = checked_step(values)
                seen.append(observation)
                rewards.append(reward)
                num_steps[row] += 1
                truncated = not terminated and (truncated or num_steps[row] >= limits[row])
                success = None
                if info or self._reads_infos or type(observation) is not np.ndarray:
                    self._masks.keep(row, observation, info)
                    self._bounds.keep(row, observation, info)
                    success = _success_in(info)
                if terminated or truncated or num_steps[row] == 1:
                    self._check_unchanged(row)
                if terminated or truncated or success is not None:
                    flags[row] = (terminated, truncated, bool(success), success is not None)
            if rows:
                self._settle(index, rows, seen)
        except Exception as error:
            self._explain("step", error)
        self.results.reward[index], self.results.flags[index] = rewards, False
        for row, of_row in flags.items():
            self.results.flags[row] = of_row

    def _natives(
        self, index: Any, option: np.ndarray | None, discrete: np.ndarray, parameters: np.ndarray
    ) -> list[Any]:
        """Return the actions of some copies in the space's own format, within the bounds of their states."""
        bounds = None
        if self.results.bounds is not None:
            low, high = self.results.bounds
            bounds = low[index], high[index]
        natives = self.actions.to_native(discrete[index], parameters[index], bounds)
        if option is None:
            return natives
        chosen = zip(natives, option[index].tolist(), strict=True)
        return [self.options.with_option(native, number) for native, number in chosen]

    def _settle(self, index: Any, rows: list[int], seen: list[Any]) -> None:
        """Keep the observations that these copies have returned.

        Args:
            index: of the copies' rows.
            rows: their numbers.
            seen: their observations.
        """
        found: Any = self.observations.quick(seen)
        if found is None:
            read = []
            for self._row, observation in zip(rows, seen, strict=True):
                read.append(self.observations.read(observation))
            found = map(np.stack, zip(*read, strict=True))
        self.results.observation[index], self.results.pixels[index] = found

    def pictures(self, num: int) -> list[np.ndarray]:
        """Return what `render` returns for the first `num` copies, uint8 `[height, width, 3]` each.

        Raises:
            ProblemError: it is no such picture.
            EnvironmentFaultError: `render` raised an error.
        """
        pictures = []
        try:
            for row in range(min(num, len(self.envs))):
                self._row = row
                picture: Any = self.envs[row].render()
                if not (isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.shape[2:] == (3,)):
                    raise ProblemError(f"render returned {_kind(picture)}, not a picture, uint8 [height, width, 3]")
                pictures.append(picture)
        except Exception as error:
            self._explain("render", error)
        return pictures

    def call(self, method: str, *arguments: Any) -> list[Any]:
        """Return what a method of the environments themselves, without wrappers, returns for each copy.

        Raises:
            ProblemError: the method raised it.
            EnvironmentFaultError: the method raised another error.
        """
        values = []
        try:
            for row, env in enumerate(self.envs):
                self._row = row
                values.append(getattr(env.unwrapped, method)(*arguments))
        except Exception as error:
            self._explain(method, error)
        return values

    def _explain(self, method: str, error: Exception) -> NoReturn:
        """Raise the error of a method, and say which copy broke its contract or raised it."""
        if isinstance(error, EnvironmentFaultError):
            raise error
        where = f"{self._name}: environment {self._first + self._row}"
        if isinstance(error, ProblemError):
            raise ProblemError(f"{where}: {error}") from error
        fault = fault_of(error, f"{where}: its {method}")
        if fault is None:
            raise error
        raise fault from error

    def close(self) -> None:
        """Close the copies, all of them even if one raises an error."""
        with ExitStack() as stack:
            for env in self.envs:
                stack.callback(env.close)


def _rate_of(env: gymnasium.Env) -> float:
    return float(env.metadata.get("render_fps") or _PICTURES_PER_SECOND)


def _kind(picture: Any) -> str:
    if isinstance(picture, np.ndarray):
        return f"an array of {picture.dtype} {list(picture.shape)}"
    return type(picture).__name__


def _success_in(info: Mapping[str, Any]) -> bool | None:
    """Return the success that the info of a step reports; None if it has no such entry."""
    for name in _SUCCESS_ENTRIES:
        if name in info:
            return flag(f"info[{name!r}]", info[name])
    return None
