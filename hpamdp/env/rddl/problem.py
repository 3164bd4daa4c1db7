"""A problem of pyRDDLGym as a Gymnasium environment whose action is a choice, numbers, or both."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from hpamdp.complaints import no_such
from hpamdp.env.gymnasium_checks import check_render_mode, reset_options
from hpamdp.env.rddl.options import RDDLRules
from hpamdp.messages import one_line, warn_once
from hpamdp.settings import SettingError

NUM_TRIALS = 4
"""Episodes that tell whether numbers begin at their default values or in mid-range."""

_NONE = spaces.Box(0.0, 1.0, (0,), np.float32)


@dataclass(frozen=True)
class Fluent:
    """An action fluent of one set of objects.

    Attributes:
        name: as pyRDDLGym writes it, such as `release___t1`.
        variable: the name that all objects share.
        place: index in the simulator's array of the variable; `()` if the variable has no objects.
        space: a `Discrete` of its values, or of whole numbers; a `Box` of shape `()` of real numbers.
        values: names of the values if the fluent is a choice; empty if it is a number.
        default: its value if it is not chosen.
    """

    name: str
    variable: str
    place: tuple[int, ...]
    space: spaces.Discrete | spaces.Box
    values: tuple[str, ...]
    default: Any


class RDDLProblem(gymnasium.Env):
    """A problem of rddlrepository, or of files of your own, as pyRDDLGym simulates it.

    If all action fluents may be set at once, the action is a `Dict`. Its entry `choices` is a `Dict` with a `Discrete`
    for each boolean or enumerated fluent. Its entry `numbers` is `Tuple(Discrete(1), Tuple(Dict))`, one discrete action
    whose parameters are the real and whole numbers. An entry that would be empty is left out.

    If only n fluents may differ from their default values, the action is a `Tuple` of n choices, or the choice itself
    if n is 1. The discrete actions of each are nothing, and a fluent with another value. A number is the parameter of
    its discrete action.

    The observation is a `Box`: the state, or what the instance shows of it, float64 `[D]`. Enumerated values are
    one-hot. If an instance allows one fluent, which is no number, and has preconditions beyond bounds, the observation
    is a `Dict` of this `Box`, `state`, and `action_mask`: the actions that the preconditions allow now.

    Args:
        render_mode: None or `rgb_array`.
        settings: those of `RDDLRules`, by name.

    Attributes:
        own_time_limit: the horizon of the instance.

    Raises:
        SettingError: an argument is wrong, pyRDDLGym is not installed or cannot read the problem, or a number has no
            bounds.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        check_render_mode("RDDLProblem", render_mode)
        self.render_mode = render_mode
        rules = RDDLRules.of(None, settings)
        self._title, self._env, constraints = _loaded(rules, is_drawn=render_mode is not None)
        self.own_time_limit = int(self._env.horizon)
        sampler, self._model = self._env.sampler, self._env.model
        self._defaults = {variable: np.array(value) for variable, value in sampler.noop_actions.items()}
        fluents = self._fluents(constraints.bounds, rules.bounds or {})
        most = min(self._env.max_allowed_actions, rules.max_actions or len(fluents))
        self._num_choices = most if most < len(fluents) else 0
        self._by_name = {fluent.name: fluent for fluent in fluents}
        # What each discrete action of a choice sets; None for the value of a number.
        self._settings: list[tuple[Fluent, int | None]] = [
            (fluent, value)
            for fluent in fluents
            for value in (range(len(fluent.values)) if fluent.values else (None,))
            if value is None or value != fluent.default
        ]
        self.action_space = self._space_of_choices() if self._num_choices else _space_of_all(fluents)
        self._observed = self._model.observ_ranges if sampler.is_pomdp else self._model.state_ranges
        has_others = not all(constraints.is_box_preconditions)
        self._has_mask = has_others and most == 1 and all(fluent.values for fluent in fluents)
        if has_others and not self._has_mask:
            cure = "; env.max_actions=1 makes masks of them" if all(fluent.values for fluent in fluents) else ""
            warn_once(f"{self._title}: the simulator does not enforce preconditions of several fluents{cure}")
        state = spaces.Box(-np.inf, np.inf, (len(self.observation_names()),), np.float64)
        mask = spaces.MultiBinary(1 + len(self._settings))
        self.observation_space = spaces.Dict(state=state, action_mask=mask) if self._has_mask else state
        self._is_over = True
        self._is_seeded = False

    def _fluents(self, bounds: Mapping[str, Any], given: Mapping[str, list[float]]) -> list[Fluent]:
        """Return the action fluents that have more than one value."""
        fluents, unbounded, names = [], {}, set()
        for variable, kind in self._model.action_ranges.items():
            values, default = self._values_of(kind), self._defaults[variable]
            for name, place in zip(self._model.variable_groundings[variable], np.ndindex(default.shape), strict=True):
                names |= {variable, name}
                space: Any = spaces.Discrete(max(1, len(values)))
                if not values:
                    low, high = (float(np.asarray(side)[place]) for side in bounds[variable])
                    narrower = given.get(name, given.get(variable, (-math.inf, math.inf)))
                    low, high = max(low, narrower[0]), min(high, narrower[1])
                    if not math.isfinite(high - low):
                        unbounded[variable] = f"{variable}:[{_shown(low, 'LOW')},{_shown(high, 'HIGH')}]"
                        continue
                    space = _space_of_number(low, high, is_whole=kind == "int")
                if space is None:
                    raise SettingError(f"{self._title}: bounds={given}: nothing is left for {name}")
                if isinstance(space, float):
                    default[place] = space
                    continue
                fluents.append(Fluent(name, variable, place, space, values, default[place]))
        unknown = next((name for name in given if name not in names), None)
        if unknown is not None:
            raise SettingError(f"bounds: {unknown}: {no_such(f'action fluent of {self._title}', unknown, names)}")
        if unbounded:
            raise SettingError(
                f"{self._title}: no bounds of the numbers {', '.join(unbounded)}; give "
                f"'env.bounds={{{','.join(unbounded.values())}}}'"
            )
        return fluents

    def _values_of(self, kind: str) -> tuple[str, ...]:
        """Return the names of the values of a boolean or enumerated fluent; none of a number."""
        if kind == "bool":
            return ("false", "true")
        return tuple(value.removeprefix("@") for value in self._model.type_to_objects.get(kind, ()))

    def _space_of_choices(self) -> spaces.Space:
        parts = [_NONE, *(_NONE if value is not None else fluent.space for fluent, value in self._settings)]
        choice = spaces.Tuple([spaces.Discrete(len(parts)), spaces.Tuple(parts)])
        return choice if self._num_choices == 1 else spaces.Tuple([choice] * self._num_choices)

    def discrete_names(self) -> tuple[str, ...]:
        """Return the names of the discrete actions, those of all components side by side."""
        if self._num_choices:
            names = ["nothing", *(_name(fluent, value) for fluent, value in self._settings)]
            return (*names,) if self._num_choices == 1 else ()
        fluents = self._by_name.values()
        names = [_name(fluent, value) for fluent in fluents for value in range(len(fluent.values))]
        return (*names, *(["numbers"] if any(not fluent.values for fluent in fluents) else []))

    def initial_numbers(self, low: np.ndarray, high: np.ndarray) -> np.ndarray | None:
        """Return where learners begin with the numbers that are always set, float64 `[P]`; None if no number is.

        They begin at their default values, or in mid-range if random play around it has a higher mean return, by more
        than two standard errors, and no rule of the domain fails. The episodes that tell begin here, so the last one
        must be over.

        Args:
            low, high: bounds of the numbers, `[P]`.
        """
        fluents = [] if self._num_choices else [fluent for fluent in self._by_name.values() if not fluent.values]
        if not fluents:
            return None
        starts = [np.array([fluent.default for fluent in fluents], np.float64).clip(low, high), 0.5 * (low + high)]
        try:
            returns = np.array(
                [[self._trial(start, low, high, seed) for seed in range(NUM_TRIALS)] for start in starts]
            )
        except Exception:  # of the simulator, whose rules cannot take every action
            return starts[0]
        error = np.sqrt(returns.var(-1, ddof=1).sum() / NUM_TRIALS)
        return starts[int(returns[1].mean() - returns[0].mean() > 2.0 * error)]

    def _trial(self, start: np.ndarray, low: np.ndarray, high: np.ndarray, seed: int) -> float:
        """Return the return of an episode of random choices, and of numbers around these, clipped to their bounds."""
        rng, total, is_over = np.random.default_rng(seed), 0.0, False
        self.action_space.seed(seed)
        self.reset(seed=seed)
        while not is_over:
            action = self.action_space.sample()
            own = action["numbers"][1][0]
            values = (start + 0.25 * (high - low) * rng.standard_normal(len(start))).clip(low, high)
            for name, value in zip(own, values, strict=True):
                own[name] = value if isinstance(self._by_name[name].space, spaces.Box) else round(value)
            _, reward, terminated, truncated, _ = self.step(action)
            total, is_over = total + reward, terminated or truncated
        return total

    def observation_names(self) -> tuple[str, ...]:
        """Return the names of the entries of the observation."""
        return tuple(
            f"{name}={value}" if value else name
            for variable, kind in self._observed.items()
            for name in self._model.variable_groundings[variable]
            for value in ("" if kind == "bool" else self._values_of(kind)) or ("",)
        )

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        reset_options(options)
        super().reset(seed=seed)
        if seed is None and not self._is_seeded:  # pyRDDLGym's own generator is one for all problems
            seed = int(self.np_random.integers(2**31))
        self._is_seeded, self._is_over = True, False
        self._env.reset(seed=seed)
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step.

        Raises:
            ResetNeeded: no episode has begun, or the last one is over.
        """
        if self._is_over:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        _, reward, terminated, truncated, info = self._env.step(self.simulator_action(action))
        self._is_over = terminated or truncated
        return self._observation(), float(reward), terminated, truncated, info

    def simulator_action(self, action: Any) -> dict[str, np.ndarray]:
        """Return an action as pyRDDLGym takes it with `vectorized=True`: an array for each variable."""
        values = {variable: default.copy() for variable, default in self._defaults.items()}
        for fluent, value in self._chosen(action):
            values[fluent.variable][fluent.place] = value
        return values

    def _chosen(self, action: Any) -> Iterator[tuple[Fluent, Any]]:
        """Yield the fluents that an action sets, and their values."""
        if self._num_choices:
            for number, parameters in [action] if self._num_choices == 1 else action:
                if number > 0:
                    fluent, value = self._settings[number - 1]
                    yield fluent, parameters[number] if value is None else value
            return
        for name, value in action.get("choices", {}).items():
            yield self._by_name[name], value
        for name, value in action["numbers"][1][0].items() if "numbers" in action else ():
            yield self._by_name[name], value

    def _observation(self) -> Any:
        values, parts = self._env.sampler.subs, []
        for variable, kind in self._observed.items():
            value = np.ravel(values[variable])
            objects = self._model.type_to_objects.get(kind)
            parts.append(value if objects is None else np.eye(len(objects))[value].ravel())
        state = np.concatenate(parts).astype(np.float64)
        return {"state": state, "action_mask": self._mask()} if self._has_mask else state

    def _mask(self) -> np.ndarray:
        """Return which actions the preconditions allow, int8; all if they allow none."""
        if self._is_over:
            return np.ones(1 + len(self._settings), np.int8)
        actions = [(number, (_NONE,)) for number in range(1 + len(self._settings))]
        check = self._env.sampler.check_action_preconditions
        mask = np.array([check(self.simulator_action(action), silent=True) for action in actions], np.int8)
        return mask if mask.any() else np.ones_like(mask)

    def render(self) -> np.ndarray | None:
        """Return the picture of pyRDDLGym, uint8 `[H, W, 3]`; None without a render mode."""
        if self.render_mode is None:
            return None
        return np.asarray(self._env.render(to_display=False).convert("RGB"))

    def close(self) -> None:
        """End the episode; the environment must be reset before it is used again."""
        self._is_over = True
        self._env.close()


def _space_of_number(low: float, high: float, *, is_whole: bool) -> spaces.Space | float | None:
    """Return the space of the numbers between two bounds; a single number itself, None if no number lies there."""
    if is_whole:
        low, high = float(math.ceil(low)), float(math.floor(high))
    if low >= high:
        return low if low == high else None
    if is_whole:
        return spaces.Discrete(int(high - low) + 1, start=int(low))
    return spaces.Box(low, high, (), np.float64)


def _space_of_all(fluents: list[Fluent]) -> spaces.Dict:
    """Return the space of actions that set all fluents."""
    entries: list[tuple[str, spaces.Space]] = []
    choices = [(fluent.name, fluent.space) for fluent in fluents if fluent.values]
    numbers = [(fluent.name, fluent.space) for fluent in fluents if not fluent.values]
    if choices:
        entries.append(("choices", spaces.Dict(choices)))
    if numbers:
        entries.append(("numbers", spaces.Tuple([spaces.Discrete(1), spaces.Tuple([spaces.Dict(numbers)])])))
    return spaces.Dict(entries)


def _name(fluent: Fluent, value: int | None) -> str:
    return fluent.name if value is None else f"{fluent.name}={fluent.values[value]}"


def _shown(bound: float, otherwise: str) -> str:
    return f"{bound:g}" if math.isfinite(bound) else otherwise


def _loaded(rules: RDDLRules, *, is_drawn: bool) -> tuple[str, Any, Any]:
    """Return the name of a problem, pyRDDLGym's environment, and its constraints.

    Raises:
        SettingError: see `RDDLProblem`.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        from pyRDDLGym import RDDLEnv
        from pyRDDLGym.core.constraints import RDDLConstraints
        from rddlrepository.core.manager import RDDLRepoManager
    except ImportError as error:
        raise SettingError("pyRDDLGym is not installed; pip install 'hpamdp[rddl]'") from error
    if rules.files is not None:
        (domain, instance), title, problem = rules.files, " ".join(rules.files), None
    else:
        repository = RDDLRepoManager()
        domains = repository.list_problems()
        if rules.domain not in domains:
            raise SettingError(f"domain={rules.domain}: {no_such('domain of rddlrepository', rules.domain, domains)}")
        problem = repository.get_problem(rules.domain)
        instances = problem.list_instances()
        number = instances[0] if rules.instance is None else str(rules.instance)
        if number not in instances:
            raise SettingError(f"instance={number}: {no_such(f'instance of {rules.domain}', number, instances)}")
        domain, instance = problem.get_domain(), problem.get_instance(number)
        title = f"{rules.domain} {number}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pyRDDLGym warns of each constraint that is no bound
            env = RDDLEnv(domain=domain, instance=instance, vectorized=True)
            constraints = RDDLConstraints(env.sampler, vectorized=True)
        if is_drawn and problem is not None:
            env.set_visualizer(problem.get_visualizer())
    except Exception as error:
        raise SettingError(f"{title}: pyRDDLGym cannot read it: {one_line(error)}") from error
    return title, env, constraints
