"""Any Gymnasium environment, as one batched TorchRL environment."""

from __future__ import annotations

import itertools
import math
import multiprocessing
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial, update_wrapper
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from PIL import Image, ImageOps
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, TensorSpec, Unbounded

from hpamdp import keys
from hpamdp.env.actions import check_action_values, invalid_action
from hpamdp.env.base import OBSERVATION_ENTRIES, PAMDPEnv, ProblemError, checked_option_names
from hpamdp.env.errors import closed_on_error
from hpamdp.env.facts import NAMING_SETTINGS
from hpamdp.env.gymnasium.copies import Copies
from hpamdp.env.gymnasium.form import NativeForm, observed_leaves
from hpamdp.env.gymnasium.making import Maker
from hpamdp.env.gymnasium.masks import as_leaf
from hpamdp.env.gymnasium.options import CARDS, GymnasiumOptions, SimulatorOptions
from hpamdp.env.gymnasium.processes import ProcessCopies
from hpamdp.env.gymnasium.scaling import ObservationScaling, RewardScaling, RunningStatistics
from hpamdp.env.registration import register
from hpamdp.env.rng_streams import folded
from hpamdp.messages import as_code, warn
from hpamdp.observation_entries import observation_dtype
from hpamdp.pickling import why_unsendable
from hpamdp.settings import SettingError, Settings
from hpamdp.unchecked import unchecked

_CPU = torch.device("cpu")
_SUCCESS = "success"
_RETURN = "unscaled_return"  # with `reward_scaling`
_SEED = "seed"
_PICTURE = "picture"
_LARGEST_PICTURE = 320  # px from edge to edge of a picture that is kept for a film
# Separate streams of seeds for training and for the fixed episodes of evaluation.
_TRAINING, _FIXED = 0, 1
# Its multiples without their whole parts fill the range from 0 to 1 evenly, however many there are.
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


class GymnasiumEnv(PAMDPEnv):
    """`num_envs` copies of a Gymnasium environment, stepped one after another, or at the same time in processes.

    `hpamdp.env.gymnasium.action_spaces` and `hpamdp.env.gymnasium.observation_spaces` tell which spaces are accepted
    and how they are converted. Parameters outside their bounds, those of the space and those of the current state, are
    clipped; those of the chosen actions must be finite.

    Bounds of the current state are also observed. The observation ends with all lower, then all upper bounds, scaled so
    that the space's bounds are -1 and 1. If the action space contains an option, the agent chooses it. The environment
    may name its options in an attribute `option_names`. The leaf `success` bool `[N]` is `is_success` or `success` in
    the info of a step, False if it has neither. With `reward_scaling`, the leaf `unscaled_return` `[N]` is the sum of
    the episode's rewards as the environment gave them.

    A copy's first reset is seeded from `seed` and the copy's number, later resets are not seeded. `reset` also takes
    the seeds to use: a tensordict with `seed` int `[N]`.

    Args:
        num_envs: number of copies.
        make: class or function that returns a new copy. If None, `id` or `entry_point` names it; otherwise both must be
            None.
        options: the settings; None for the defaults.
        device: of the tensors.
        seed: of the episodes, see above.
        first_env: number of the first copy, if other processes have those before it.
        flatten_pictures: whether pictures are numbers of the vector, scaled like others.
        settings: single settings by name, in place of those in `options`.

    Raises:
        ValueError: an argument, a space or an action is invalid; after an invalid action no copy has moved.
        ProblemError: a copy gave what its own spaces do not have.
    """

    Options: ClassVar[type[Settings]] = GymnasiumOptions
    card = CARDS["GymnasiumEnv"]
    result_keys: tuple[str, ...] = (_SUCCESS,)

    def __init__(
        self,
        num_envs: int = 1,
        *,
        make: Callable[..., Any] | None = None,
        options: GymnasiumOptions | None = None,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
        flatten_pictures: bool = False,
        **settings: Any,
    ) -> None:
        options = self.options = GymnasiumOptions.of(options, settings)
        for name in NAMING_SETTINGS:
            value = getattr(options, name)
            if make is not None and value is not None:
                raise SettingError(f"GymnasiumEnv: make={as_code(make)} and env.{name}={value}: give only one of them")
        # Not a check of the model: the command that resumes a run need not repeat them.
        if make is None and (options.id is None) == (options.entry_point is None):
            given = "neither is" if options.id is None else "both are"
            raise SettingError(f"set env.id=Name-v0 or env.entry_point=package.module:name; {given} set")
        register()
        num_envs, seed, first_env = self.checked_numbers(num_envs, seed, first_env)
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs = num_envs
        self.first_env = first_env
        self._name = f"GymnasiumEnv: {options.entry_point or options.id or getattr(make, '__name__', 'environment')}"
        maker = Maker(self._name, options.id, options.entry_point or make, options.kwargs, options.max_steps)
        self._settings = options
        self._copies = self._make_copies(maker, flatten_pictures)
        self.is_closed = False  # TorchRL's flag: from here on there are copies to close
        with closed_on_error(self):
            self._set_up(seed)

    def _set_up(self, seed: int) -> None:
        """Read from the copies what the environment is, and prepare for the first episodes."""
        options, num_envs = self.options, self.num_envs
        self.max_steps, self._usual_length = self._copies.max_steps, self._copies.usual_length
        actions = self._copies.actions
        self.parameter_dims = actions.parameter_dims
        self.component_sizes, self.integer_parameters = actions.component_sizes, actions.integer_parameters
        try:
            self.scaling = ObservationScaling(
                self._copies.observations, options.observation_scaling, options.raw_observations or ()
            )
        except ValueError as error:
            raise SettingError(f"{self._name}: {error}") from error
        self.option_names = self._names_of_options()
        dim, num_bounded = self._copies.observations.dim, self._copies.results.num_bounded
        self.observation_entries = self._copies.observations.entries(2 * num_bounded)
        self.bounds_place = dim if num_bounded else None
        gamma = options.reward_scaling
        self._reward_scaling = None if gamma is None else RewardScaling(num_envs, gamma, options.reward_clip)
        if gamma is not None:
            self.result_keys = (_SUCCESS, _RETURN)
        self._make_specs()
        num_parameters = sum(self.parameter_dims)
        self._action_shapes = (
            torch.Size((num_envs, *self.components.shape)),
            torch.Size((num_envs, num_parameters)),
        )
        self._last_choices = np.array(self.components.sizes) - 1
        self._observation = np.zeros((num_envs, dim), np.float32)
        self._is_over = np.zeros(num_envs, bool)
        self._rows = [*range(num_envs)]
        self._is_staggered = options.staggered
        self._terminates_at_limit = options.terminates_at_limit
        self._first_ends = np.zeros(num_envs, np.int64)  # steps to the end of a staggered first episode; else 0
        self._reports_success = False
        self._set_seed(seed)

    def _make_copies(self, make: Maker, flattens_pictures: bool) -> Copies | ProcessCopies:
        num_workers = self._settings.num_workers
        if num_workers == 0:
            return Copies(make, self.num_envs, self._settings, flattens_pictures)
        if multiprocessing.current_process().daemon:
            raise SettingError(f"{self._name}: {num_workers=}: a worker process cannot start others; use 0")
        why = why_unsendable(make)
        if why is not None:
            raise SettingError(
                f"{self._name}: {num_workers=}: cannot be sent to processes ({why}); create what it refers to in its "
                "constructor or function, or use 0"
            )
        return ProcessCopies(make, self.num_envs, self._settings, flattens_pictures)

    @property
    def envs(self) -> list[gymnasium.Env]:
        """The copies; none if other processes have them."""
        return self._copies.envs

    @property
    def is_shardable(self) -> bool:
        """Whether no processes are started, which a worker process may not do."""
        return self.options.num_workers == 0

    @property
    def title(self) -> str:
        """The class and what it was made from."""
        return self._name

    def fixed_episodes(self, seed: int) -> TensorDict:
        """Return seeds to `reset` with, one for each copy, from another stream than those of training."""
        seeds = torch.tensor(_seeds(seed, self.num_envs, _FIXED, self.first_env), device=self.device)
        return TensorDict({_SEED: seeds}, batch_size=self.batch_size, device=self.device)

    def warn_if_seed_is_ignored(self, seed: int) -> None:
        """Warn if two resets of the first copy with the same seed return different observations.

        It ends the running episode of this copy.
        """
        (first,) = _seeds(seed, 1, _FIXED)

        def begun() -> np.ndarray:
            self._copies.reset({0: first})
            return self._copies.results.observation[0].copy()

        if not np.array_equal(begun(), begun(), equal_nan=True):
            warn(
                f"{self._name}: two resets with the same seed began differently, so evaluations cannot be repeated, "
                "and copies may play the same episodes; call super().reset(seed=seed) and draw from self.np_random"
            )

    def gymnasium_form(self) -> NativeForm:
        """Return the form of the environment itself."""
        return NativeForm(self._copies, self.scaling, self._settings)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `success` bool `[M]` if any info so far had it, and with `reward_scaling` the unscaled `return`."""
        success = last.get(_SUCCESS)
        # A success in `last` may have been reported to a copy in another process.
        self._reports_success |= bool(success.any())
        results = {_SUCCESS: success} if self._reports_success else {}
        return results if self._reward_scaling is None else {"return": last.get(_RETURN), **results}

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]] | None:
        """The lowest and the highest scaled observation; None with running statistics or `out_of_bounds=allow`."""
        if self.scaling.statistics is not None or self._settings.out_of_bounds == "allow":
            return None
        observations, num_bounded = self._copies.observations, self._copies.results.num_bounded
        with np.errstate(over="ignore"):
            both = self.scaling.rescaled(np.stack(observations.bounds()))
        ends = [(-1.0, 0.0), (1.0, 255.0)]  # of the bounds of the current state, and of pixels
        low, high = (
            [*own.tolist(), *np.repeat(end, (2 * num_bounded, observations.num_pixels))]
            for own, end in zip(both, ends, strict=True)
        )
        return low, high

    def scaled_rows(self, rows: TensorDict) -> TensorDict:
        """Return recorded transitions as the agent sees them, given in the numbers of the environment's own spaces.

        Only `observation`, `next.observation` and the action are changed. The agent counts discrete actions from 0.

        Args:
            rows: `[N]`, with flattened observations without pictures and bounds, `[N, dim]`; see `Demonstrations`.
        """
        rows, actions = rows.clone(), self._copies.actions
        for name in (keys.OBSERVATION, ("next", keys.OBSERVATION)):
            rows[name] = torch.from_numpy(self.scaling.rescaled(rows[name].double().numpy()))
        rows[keys.PARAMETERS] = torch.from_numpy(actions.map.parameters(rows[keys.PARAMETERS].double().numpy())).float()
        starts = torch.tensor(actions.starts)
        rows[keys.DISCRETE] = rows[keys.DISCRETE] - (starts if self.component_sizes else starts[0])
        return rows

    def ranges(self) -> dict[str, list[float]]:
        """Return bounds, first discrete actions, checksums of the observation's entries, and its fixed scale."""
        actions = self._copies.actions
        entries = [leaf.path for leaf in self._copies.observations.leaves if leaf.path]
        ranges: dict[str, Iterable[float]] = {
            "parameter_low": actions.own_low,
            "parameter_high": actions.own_high,
            "first_action": [*actions.starts, self._copies.options.start],
            OBSERVATION_ENTRIES: [zlib.crc32(repr(path).encode()) for path in entries],
        }
        if self.scaling.statistics is None:
            ranges["observation_centre"], ranges["observation_half_width"], _ = self.scaling.linear_map()
        return {name: [float(number) for number in numbers] for name, numbers in ranges.items()}

    def set_scaling_from(self, other: PAMDPEnv) -> None:
        """Scale observations by the running statistics of `other`, now and later, without updating them.

        Without running statistics this changes nothing. If `other` is a problem of this package, whose agents read its
        observations as they are, these are not scaled.

        Raises:
            ValueError: the two differ in their scaling or in the length of their observations.
        """
        if isinstance(other, GymnasiumEnv):
            self.scaling.share(other.scaling)
        else:
            self.scaling = ObservationScaling(self._copies.observations, "none")

    def seed_evaluation(self, seed: int) -> None:
        """Seed the episodes of an evaluation, which reports rewards as they are."""
        super().seed_evaluation(seed)
        if self._reward_scaling is not None:
            self._reward_scaling.is_off = True

    @property
    def keeps_episodes(self) -> bool:
        """Whether episodes continue in a resumed run: no, the state of somebody else's environment is unknown."""
        return False

    def env_state(self) -> dict[str, Tensor]:
        """Return the running statistics, if there are any; the state of the episodes is unknown."""
        return {name: column for each in self._statistics() for name, column in each.columns().items()}

    def _statistics(self) -> list[RunningStatistics]:
        kept = [self.scaling.statistics, None if self._reward_scaling is None else self._reward_scaling.statistics]
        return [statistics for statistics in kept if statistics is not None]

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Continue with saved running statistics; new episodes start.

        Raises:
            ValueError: the statistics are of observations of another length.
        """
        for statistics in self._statistics() if columns else ():
            statistics.set_columns(columns)

    def statistics(self) -> dict[str, Tensor]:
        """Return the running statistics: they are the whole `env_state`."""
        return self.env_state()

    def set_statistics(self, columns: Mapping[str, Tensor]) -> None:
        """Continue with saved running statistics: they are the whole `env_state`."""
        self.set_env_state(columns)

    def take_new_statistics(self) -> dict[str, Tensor]:
        """Return the statistics of what was observed since the last call alone."""
        return {name: column for each in self._statistics() for name, column in each.take_new().items()}

    def add_statistics(self, columns: Mapping[str, Tensor]) -> None:
        """Add what another process has taken by `take_new_statistics`."""
        for statistics in self._statistics():
            statistics.add(columns)

    def film_state(self, num: int) -> dict[str, Tensor]:
        """Return what the first `num` copies draw, if their `render_mode` is `rgb_array`: uint8 `[num, S, S, 3]`.

        Pictures that are not square get white margins. S is that of the largest one, or less.
        """
        if not self._copies.has_pictures:
            return {}
        images = [Image.fromarray(picture) for picture in self._copies.pictures(num)]
        side = min(_LARGEST_PICTURE, max(max(image.size) for image in images))
        squares = [np.array(ImageOps.pad(image, (side, side), color="white")) for image in images]
        return {_PICTURE: torch.from_numpy(np.stack(squares))}

    def film(self, track: Sequence[Mapping[str, Tensor]], fps: float, size: int) -> Iterator[np.ndarray]:
        """Yield the pictures of `render`, each for as long as the environment's `render_fps` says.

        If that is shorter than a picture of the film, some states are left out, but never the last one.
        """
        for number, state in enumerate(track):
            image = Image.fromarray(state[_PICTURE][0].numpy())
            picture = np.array(ImageOps.pad(image, (size, size), color="white"))
            shown = [round(fps * count / self._copies.pictures_per_second) for count in (number, number + 1)]
            is_last = number == len(track) - 1
            yield from itertools.repeat(picture, max(shown[1] - shown[0], int(is_last)))

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the copies, which can neither step nor begin an episode afterwards."""
        if not self.is_closed:
            self._copies.close()
        super().close(raise_if_closed=raise_if_closed)

    def _check_open(self) -> None:
        if self.is_closed:
            raise RuntimeError(f"{self._name} is closed; make a new one")

    def _names_of_options(self) -> tuple[str, ...]:
        num_options = self._copies.options.num_options
        given = self._copies.option_names
        try:
            names = checked_option_names(() if given is None else given)
        except ProblemError as error:
            raise SettingError(f"{self._name}: {error}") from error
        return names if num_options and len(names) == num_options else tuple(f"option{i}" for i in range(num_options))

    def _make_specs(self) -> None:
        n = self.num_envs
        device = self.device
        results, num_discrete = self._copies.results, len(self.parameter_dims)
        self.observation_spec = Composite(
            {
                keys.OBSERVATION: self._observation_spec(),
                _SUCCESS: Categorical(2, shape=(n,), dtype=torch.bool, device=device),
            },
            shape=(n,),
        )
        if self._reward_scaling is not None:
            self.observation_spec[_RETURN] = Unbounded(shape=(n,), device=device, dtype=torch.float32)
        for name, mask in results.masks.items():
            shape = (num_discrete, num_discrete) if name == keys.PAIR_MASK else mask.shape[1:]
            self.observation_spec[name] = Binary(shape[-1], shape=(n, *shape), dtype=torch.bool, device=device)
        for name in (keys.PARAMETER_LOW, keys.PARAMETER_HIGH) if results.num_bounded else ():
            bound = Unbounded(shape=(n, results.num_bounded), device=device, dtype=torch.float32)
            self.observation_spec[name] = bound
        low = torch.from_numpy(self._copies.actions.low)
        high = torch.from_numpy(self._copies.actions.high)
        self.action_spec = self.make_action_spec(low, high, has_option=self._copies.options.num_options > 0)
        self.reward_spec = Unbounded(shape=(n, 1), device=device, dtype=torch.float32)
        self.done_spec = self.make_done_spec()

    def _observation_spec(self) -> TensorSpec:
        observations, dtype = self._copies.observations, observation_dtype(self.observation_entries)
        num_bounds = 2 * self._copies.results.num_bounded
        shape = (self.num_envs, observations.dim + num_bounds + observations.num_pixels)
        if dtype == torch.uint8:
            return Bounded(0, 255, shape=shape, device=self.device, dtype=dtype)
        return Unbounded(shape=shape, device=self.device, dtype=dtype)

    def _set_seed(self, seed: int | None) -> None:
        # Of each copy's next reset; None after its first one.
        self._next_seeds: list[int | None] = [
            *_seeds(0 if seed is None else seed, self.num_envs, _TRAINING, self.first_env)
        ]

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        self._check_open()
        mask = None if tensordict is None else tensordict.get("_reset", None)
        given = None if tensordict is None else tensordict.get(_SEED, None)
        if given is not None and (given.shape != (self.num_envs,) or given.is_floating_point() or (given < 0).any()):
            raise ValueError(f"reset: {_SEED} must be integers of at least 0 in shape [{self.num_envs}]")
        is_reset = np.ones(self.num_envs, bool) if mask is None else mask.reshape(-1).cpu().numpy()
        seeds = self._next_seeds if given is None else given.tolist()
        rows = np.flatnonzero(is_reset).tolist()
        chosen = {row: seeds[row] for row in rows}
        for row in rows:
            self._next_seeds[row] = None
        self._copies.reset(chosen)
        self._first_ends[is_reset] = 0
        if self._is_staggered and mask is None and given is None:
            numbers = np.arange(self.first_env, self.first_env + self.num_envs)
            self._first_ends[:] = np.ceil(numbers * _GOLDEN % 1.0 * self._usual_length)
        self._scale(is_reset, is_all=len(rows) == self.num_envs)
        if self._reward_scaling is not None:
            self._reward_scaling.begin(is_reset)
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._check_open()
        chosen, values = self._read_action(tensordict)
        option = self._read_option(tensordict)
        results, is_stepped = self._copies.results, ~self._is_over
        if "_step" in tensordict.keys():
            is_stepped &= tensordict.get("_step").reshape(-1).numpy(force=True)
        is_all = bool(is_stepped.all())
        self._copies.step(self._rows if is_all else np.flatnonzero(is_stepped).tolist(), option, chosen, values)
        terminated, truncated, *_ = results.flags.T
        if self._terminates_at_limit:
            terminated[is_stepped & truncated] = True
        if self._first_ends.any():
            truncated[is_stepped & (self._first_ends == 1) & ~terminated] = True
            self._first_ends -= is_stepped & (self._first_ends > 0)
        self._scale(is_stepped, is_all=is_all)
        rewards = results.reward if is_all else np.where(is_stepped, results.reward, 0.0)
        if self._reward_scaling is not None:
            rewards = self._reward_scaling.scaled(rewards, is_stepped)
        return self._read(self._in_float32(rewards))

    def step_and_restart(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase] | None:
        """Step and reset without TorchRL's work between them, see `PAMDPEnv.step_and_restart`."""
        if "_step" in tensordict.keys():
            return None
        after = self._step(tensordict)
        if self._is_over.any():
            return after, self._reset(unchecked({"_reset": after.get(keys.DONE)}, self))
        return after, unchecked({name: leaf for name, leaf in after.items() if name != keys.REWARD}, self)

    def _in_float32(self, rewards: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):
            rounded = rewards.astype(np.float32)
        is_wrong = ~np.isfinite(rounded)
        if is_wrong.any():
            row = int(is_wrong.argmax())
            where = f"{self._name}: environment {self.first_env + row}"
            raise ProblemError(f"{where}: step returned the reward {rewards[row]:g}, which is not finite in float32")
        return rounded

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        # `_read` returns every entry in its final shape. TorchRL takes a quarter of its own time to check that.
        return next_tensordict_out

    def _read_action(self, tensordict: TensorDictBase) -> tuple[np.ndarray, np.ndarray]:
        """Return the discrete actions `[N, ...]` and all parameters `[N, num_parameters]`, checked."""
        discrete, parameters = tensordict.get(keys.DISCRETE), tensordict.get(keys.PARAMETERS)
        # The quick way for what almost every step gets. Otherwise the full checks say what is wrong.
        is_usual = (
            self._copies.options.num_options == 0
            and self.option_actions is None
            and discrete is not None
            and parameters is not None
            and discrete.dtype == torch.int64
            and (discrete.shape, parameters.shape) == self._action_shapes
        )
        if not is_usual:
            self.check_action(tensordict)
        chosen, values = discrete.numpy(force=True), parameters.numpy(force=True)
        if not self.component_sizes:
            numbers = chosen.tolist()
            exists = min(numbers) >= 0 and max(numbers) < len(self.parameter_dims)
        else:
            exists = bool(((chosen >= 0) & (chosen <= self._last_choices)).all())
        # If the sum of squares is finite, so are the numbers. If not, the full check decides.
        if not (math.isfinite(np.vdot(values, values)) and exists):
            check_action_values(discrete, parameters, self.parameter_dims, self.components)
        return chosen, values

    def _read_option(self, tensordict: TensorDictBase) -> np.ndarray | None:
        """Return the options `[N]`, checked; None if the environment itself has none."""
        num_options = self._copies.options.num_options
        if num_options == 0:
            return None
        option = tensordict.get(keys.OPTION).cpu().numpy()
        is_wrong = (option < 0) | (option >= num_options)
        if is_wrong.any():
            row = int(is_wrong.argmax())
            raise invalid_action(row, {keys.OPTION: (int(option[row]), f"allowed 0 to {num_options - 1}")})
        return option

    def _scale(self, is_new: np.ndarray, *, is_all: bool) -> None:
        """Scale the observations of these rows, bool `[N]`, and keep them; `is_all` if these are all rows."""
        vectors = self._copies.results.observation
        if is_all:
            self._observation[:] = self.scaling.scaled(vectors)
        elif is_new.any():
            self._observation[is_new] = self.scaling.scaled(vectors[is_new])

    def _read(self, reward: np.ndarray | None = None) -> TensorDict:
        """Return the last results, with the rewards `[N]` if they are those of a step."""
        results = self._copies.results
        # A copy, so that the next step does not change what was returned.
        terminated, truncated, success, has_success = results.flags.T.copy()
        self._reports_success = self._reports_success or bool(has_success.any())
        done = terminated | truncated
        self._is_over[:] = done
        leaves: dict[Any, Tensor] = {
            **observed_leaves(self._observation, results.bounds, results.pixels, self._copies.actions),
            _SUCCESS: torch.from_numpy(success),
            keys.TERMINATED: torch.from_numpy(terminated[:, None]),
            keys.TRUNCATED: torch.from_numpy(truncated[:, None]),
            keys.DONE: torch.from_numpy(done[:, None]),
        }
        if self._reward_scaling is not None:
            leaves[_RETURN] = torch.from_numpy(self._reward_scaling.totals.astype(np.float32))
        for name, mask in results.masks.items():
            leaves[name] = as_leaf(name, torch.from_numpy(mask.copy()), len(self.parameter_dims))
        if reward is not None:
            leaves[keys.REWARD] = torch.from_numpy(reward[:, None])
        device = self.device
        if device is not None and device != _CPU:
            leaves = {name: leaf.to(device) for name, leaf in leaves.items()}
        td = unchecked(leaves, self)
        return self.check_masks(td) if results.masks else td


class SimulatorEnv(GymnasiumEnv):
    """A problem with settings of its own, whose copies are Gymnasium environments of the class `simulator`.

    Settings that have the name of a setting of `GymnasiumEnv`, such as `max_steps`, mean the same. See `GymnasiumEnv`
    for the arguments and the errors.
    """

    Options: ClassVar[type[Settings]]
    options: SimulatorOptions
    simulator: ClassVar[Callable[..., gymnasium.Env]]
    simulator_options: ClassVar[type[Settings]]  # the model of the settings that the simulator takes
    reading: ClassVar[Mapping[str, Any]] = {}  # settings of `GymnasiumEnv` that differ from its defaults

    def __init__(
        self,
        num_envs: int = 1,
        *,
        options: SimulatorOptions | None = None,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
        **settings: Any,
    ) -> None:
        given: Any = self.Options.of(options, settings)
        rules = {name: getattr(given, name) for name in self.simulator_options.model_fields}
        make = partial(self.simulator, render_mode="rgb_array" if given.render else None, **rules)
        update_wrapper(make, self.simulator)  # so that errors name the simulator
        shared = dict(given).keys() & GymnasiumOptions.model_fields.keys() - rules.keys()
        reading = {**self.reading, **{name: getattr(given, name) for name in shared}}
        super().__init__(num_envs, make=make, device=device, seed=seed, first_env=first_env, **reading)
        self.options = given
        self._prepare()

    def _prepare(self) -> None:
        """Set what follows from the settings, such as the names of the actions."""


def _seeds(seed: int, num: int, stream: int, first: int = 0) -> list[int]:
    """Return 31-bit seeds, which every generator takes, for the `num` copies from number `first` on."""
    rows, seed = range(first, first + num), folded(seed)
    return [int(np.random.SeedSequence((seed, row, stream)).generate_state(1)[0] >> 1) for row in rows]
