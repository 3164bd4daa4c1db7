"""Boats with NumPy in and out: Gymnasium's spaces, and the checks of its actions.

An action of one boat has one of two formats. In batched spaces every leaf has a leading `[N]`, as is usual in
Gymnasium.

- `dict`: `{"key": 0 to 2, "duration": [3] seconds in [0, 2]}`. There is a duration for each key, and only the pressed
  key's duration counts.
- `tuple`, the field's convention: `(key, (seconds [1], seconds [1], seconds [1]))`.

With `controller="choose"` an action also has an option: 0 (incongruent) or 1 (congruent), or the number of a boat in
`boats`. In a dict it is the entry `"option"`. In a tuple it comes first: `(option, key, (...))`. It is read at an
episode's first press. With a `switch_cost` it is read at every press.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from gymnasium import spaces

from hpamdp.env.boatdock import kernel, task
from hpamdp.env.boatdock.layouts import layout_columns
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.task import BoatState
from hpamdp.env.gymnasium_adapter import NumpyRows
from hpamdp.env.gymnasium_checks import as_array, describe, parameter_arrays, reset_options
from hpamdp.env.kernel_rows import KernelRows, invalid_choice

ActionFormat = Literal["dict", "tuple"]

_TANK = np.float32(task.TANK)
_OUTCOME_NAMES = np.array(task.OUTCOMES, dtype=object)
_OPTION_SHAPES = {"start": (2,), "goal": (2,), "controller": (), "keymap": ()}
# Gaussian numbers from 23-bit uniform ones stay within 5.8 standard deviations.
_LARGEST_NORMAL = 6.0


def action_space(rules: BoatDockOptions, action_format: ActionFormat) -> spaces.Dict | spaces.Tuple:
    """Return the action space of one boat. The module's docstring explains the formats."""
    has_choice = rules.controller == "choose"
    option = spaces.Discrete(len(rules.names))
    key = spaces.Discrete(task.NUM_KEYS)
    if action_format == "dict":
        duration = spaces.Box(0.0, task.MAX_DURATION, (task.NUM_KEYS,))
        leaves: dict[str, spaces.Space] = {"key": key, "duration": duration}
        if has_choice:
            leaves["option"] = option
        return spaces.Dict(leaves)
    durations = spaces.Tuple([spaces.Box(0.0, task.MAX_DURATION, (1,)) for _ in range(task.NUM_KEYS)])
    return spaces.Tuple((option, key, durations) if has_choice else (key, durations))


def observation_space(rules: BoatDockOptions) -> spaces.Box:
    """Return the observation space of one boat, float32, with the bounds that layouts, motion and noise can reach."""
    is_pixels = rules.observation == "pixels"
    unit = 1.0 if is_pixels else 1.0 / task.HARBOUR_RADIUS
    top_speed = 1.01 * (task.SPEED_SCALE if is_pixels else 1.0)
    # The extra px allows for rounding.
    reach = task.HARBOUR_RADIUS + 1.0 + _LARGEST_NORMAL * rules.sensor_noise
    bounds = {
        "radius": (0.0, 2.0 * task.HARBOUR_RADIUS * unit),
        "controller": (-1.0, len(rules.names) - 1.0),
        "fuel": (0.0, 1.0),
        # The unit is the distance at the start, which counts as at least the radius of the dock.
        "distance": (0.0, 2.0 * 2.0**0.5 * reach / task.DOCK_RADIUS),
    }
    for axis, centre in zip("xy", task.CENTRE if is_pixels else (0.0, 0.0), strict=True):
        for point in ("start", "goal", "centre", "boat"):
            bounds[f"{point}_{axis}"] = (centre - reach * unit, centre + reach * unit)
        bounds[f"velocity_{axis}"] = (-top_speed, top_speed)
        bounds[f"to_goal_{axis}"] = (-2.0 * reach * unit, 2.0 * reach * unit)
    low, high = np.array([bounds[name] for name in task.observation_names(rules.observation)], dtype=np.float32).T
    return spaces.Box(low, high, dtype=np.float32)


def boat_rows(num_boats: int, rules: BoatDockOptions) -> KernelRows:
    """Return the rows of boats, moved by the kernel."""
    has_choice = rules.controller == "choose"
    return KernelRows(
        kernel.advance,
        num_boats,
        num_columns=(9, 5),
        reading_dims=(len(task.observation_names(rules.observation)), 1),
        parameter_dims=(1,) * task.NUM_KEYS,
        bounds=[[0.0] * task.NUM_KEYS, [task.MAX_DURATION] * task.NUM_KEYS],
        settings=[task.MAX_PRESSES, len(rules.names) if has_choice else 0, *kernel.settings_of(rules)],
    )


class NumpyBoats(NumpyRows):
    """One boat or many, with NumPy in and out.

    Args:
        rules: rules of the environment.
        batch: `()` for one boat, `(N,)` for N boats.
        action_format: `dict` or `tuple`.
    """

    final_infos = ("score",)

    def __init__(self, rules: BoatDockOptions, batch: tuple[int, ...], action_format: ActionFormat) -> None:
        if action_format not in ("dict", "tuple"):
            raise ValueError(f"BoatDock: action_format={action_format!r}, but must be dict or tuple")
        num_boats = batch[0] if batch else 1
        if num_boats < 1:
            raise ValueError(f"BoatDock: num_envs={num_boats}, but must be at least 1")
        super().__init__(boat_rows(num_boats, rules), batch)
        self._rules = rules
        self.has_choice = rules.controller == "choose"
        self.action_space = action_space(rules, action_format)
        self.observation_space = observation_space(rules)
        self._is_tuple = action_format == "tuple"
        self._leaf_names = ("option", "key", "duration") if self.has_choice else ("key", "duration")
        self._leaf_set = set(self._leaf_names)

    @property
    def state(self) -> BoatState:
        """A copy of the boats' state."""
        return BoatState(*self.rows.floats.copy(), *self.rows.integers.copy())

    def _invalid(self, row: int, leaves: tuple[Any, Any, Any]) -> ValueError:
        return invalid_choice(row, leaves, (1,) * task.NUM_KEYS, len(self._rules.names), ("key", "durations"))

    def infos(self) -> dict[str, np.ndarray]:
        """Return the infos, `[N]` each. `score` has a meaning only if the episode is over."""
        integers = self.rows.integers
        fuel = (self.rows.floats[kernel.FUEL] / _TANK).astype(np.float64)
        outcome = integers[kernel.OUTCOME]
        return {
            "outcome": _OUTCOME_NAMES[outcome],
            "fuel": fuel,
            "presses": integers[kernel.PRESSES].astype(np.int64),
            "controller": integers[kernel.CONTROLLER].astype(np.int64),
            "score": np.where(outcome == task.SUCCESS, task.SUCCESS_REWARD * fuel, task.FAILURE_REWARD),
        }

    def info(self) -> dict[str, Any]:
        """Return the infos of the first boat as Python numbers."""
        controller, _, presses, outcome, _ = self.rows.integers[:, 0].tolist()
        fuel = float(self.rows.floats[kernel.FUEL, 0] / _TANK)
        values = {"outcome": task.OUTCOMES[outcome], "fuel": fuel, "presses": presses, "controller": controller}
        if outcome != task.SAILING:
            values["score"] = task.SUCCESS_REWARD * fuel if outcome == task.SUCCESS else task.FAILURE_REWARD
        return values

    def _start_columns(self, options: Mapping[str, Any]) -> Mapping[int, np.ndarray]:
        if not options:
            return {}
        reset_options(options, [*_OPTION_SHAPES])
        missing = {"start", "goal"} - set(options)
        if missing:
            raise ValueError(f"reset: options {sorted(options)} lack {sorted(missing)}: a layout has both points")
        given = {}
        for name, value in options.items():
            shape = _OPTION_SHAPES[name]
            array = as_array(f"reset: {name}", value, self._batch + shape, is_integer=shape == ())
            given[name] = array.reshape(self._num_envs, *shape)
        columns = layout_columns(given, self._num_envs, self._rules)
        return {BoatState._fields.index(name): column for name, column in columns.items()}

    def _leaves(self, action: Any) -> tuple[np.ndarray | None, np.ndarray, np.ndarray]:
        """Check the structure, types and shapes of an action and return options, keys and durations."""
        if self._is_tuple:
            action = self._named(action)
        elif not isinstance(action, dict | Mapping) or action.keys() != self._leaf_set:
            names = ", ".join(self._leaf_names)
            raise ValueError(f"step: the action must be a dict with keys {names}, but is {describe(action)}")
        durations = as_array("step: duration", action["duration"], (*self._batch, task.NUM_KEYS))
        option = self._integers("option", action["option"]) if self.has_choice else None
        if durations.dtype != np.float32 or not durations.flags.c_contiguous:
            durations = np.ascontiguousarray(durations, np.float32)
        durations = durations if self._batch else durations.reshape(1, task.NUM_KEYS)
        return option, self._integers("key", action["key"]), durations

    def _named(self, action: Any) -> dict[str, Any]:
        """Return a tuple action as a dict of its leaves."""
        if not isinstance(action, (tuple, list)) or len(action) != len(self._leaf_names):
            names = ", ".join(self._leaf_names)
            raise ValueError(f"step: the action must be a tuple ({names}), but is {describe(action)}")
        named = dict(zip(self._leaf_names, action, strict=True))
        durations = parameter_arrays(named["duration"], (1,) * task.NUM_KEYS, self._batch, name="duration")
        named["duration"] = np.concatenate(durations, axis=-1)
        return named
