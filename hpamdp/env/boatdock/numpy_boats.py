"""BoatDockEnv with NumPy in and out: Gymnasium's spaces, and the checks between its actions and our tensors.

Formats of an action, for one boat (batched spaces are Gymnasium's own: every leaf has a leading `[N]`):

- `dict`: `{"key": 0 to 2, "duration": [3] seconds in [0, 2]}`, a duration for each key, of which only the pressed
  key's counts; with `controller="choose"` also `"option": 0 (incongruent) or 1 (congruent)`, which is read at an
  episode's first press.
- `tuple`, the field's convention: `(key, (seconds [1], seconds [1], seconds [1]))`; with `controller="choose"` the
  option comes first: `(option, key, (...))`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict, TensorDictBase

from hpamdp import keys
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.episode import OBSERVATION_NAMES, SCALED_NAMES, BoatState, Rules
from hpamdp.env.faces import NumpyEnv, as_array, describe, to_numpy

ActionFormat = Literal["dict", "tuple"]

_OPTION_SHAPES = {"start": (2,), "goal": (2,), "controller": (), "keymap": ()}
# Gaussian numbers that are made from 23-bit uniform ones stay within 5.8 standard deviations.
_LARGEST_NORMAL = 6.0


def action_space(has_choice: bool, action_format: ActionFormat) -> spaces.Dict | spaces.Tuple:
    """Return the action space of one boat; see the module's docstring."""
    option = spaces.Discrete(len(harbour.CONTROLLERS))
    key = spaces.Discrete(harbour.NUM_KEYS)
    if action_format == "dict":
        duration = spaces.Box(0.0, physics.MAX_DURATION, (harbour.NUM_KEYS,))
        leaves: dict[str, spaces.Space] = {"key": key, "duration": duration}
        if has_choice:
            leaves["option"] = option
        return spaces.Dict(leaves)
    durations = spaces.Tuple([spaces.Box(0.0, physics.MAX_DURATION, (1,)) for _ in range(harbour.NUM_KEYS)])
    return spaces.Tuple((option, key, durations) if has_choice else (key, durations))


def observation_space(rules: Rules) -> spaces.Box:
    """Return the observation space of one boat: float32, bounded by what layouts, motion and noise can reach."""
    is_pixels = rules.observation == "pixels"
    unit = 1.0 if is_pixels else 1.0 / physics.HARBOUR_RADIUS
    top_speed = 1.01 * (float(physics.speed(torch.tensor(physics.MAX_DURATION))) if is_pixels else 1.0)
    # One px more than the geometry allows, for rounding.
    reach = physics.HARBOUR_RADIUS + 1.0 + _LARGEST_NORMAL * rules.sensor_noise
    bounds = {
        "radius": (0.0, 2.0 * physics.HARBOUR_RADIUS * unit),
        "controller": (-1.0, 1.0),
        "fuel": (0.0, 1.0),
        # In units of the distance at the start, which counts as at least the radius of the dock.
        "distance": (0.0, 2.0 * 2.0**0.5 * reach / physics.DOCK_RADIUS),
    }
    for axis, centre in zip("xy", harbour.CENTRE if is_pixels else (0.0, 0.0), strict=True):
        for point in ("start", "goal", "centre", "boat"):
            bounds[f"{point}_{axis}"] = (centre - reach * unit, centre + reach * unit)
        bounds[f"velocity_{axis}"] = (-top_speed, top_speed)
        bounds[f"to_goal_{axis}"] = (-2.0 * reach * unit, 2.0 * reach * unit)
    names = OBSERVATION_NAMES if is_pixels else SCALED_NAMES
    low, high = np.array([bounds[name] for name in names], dtype=np.float32).T
    return spaces.Box(low, high, dtype=np.float32)


class NumpyBoats(NumpyEnv):
    """BoatDockEnv with NumPy in and out: one boat (`batch=()`) or many (`batch=(N,)`)."""

    final_infos = ("score",)

    def __init__(self, env: BoatDockEnv, batch: tuple[int, ...], action_format: ActionFormat) -> None:
        if action_format not in ("dict", "tuple"):
            raise ValueError(f"BoatDock: action_format={action_format!r}, but must be dict or tuple")
        self.env = env
        self.is_reset = False
        self.action_space = action_space(env.has_choice, action_format)
        self.observation_space = observation_space(env.rules)
        self._batch = batch
        self._is_tuple = action_format == "tuple"
        self._leaf_names = ("option", "key", "duration") if env.has_choice else ("key", "duration")

    @property
    def state(self) -> BoatState:
        """The boats as they are."""
        return self.env.state

    def reset(self, seed: int | None, options: Mapping[str, Any] | None, mask: np.ndarray | None = None) -> np.ndarray:
        """Start new episodes, in the rows of `mask` or in all, and return the observations `[N, observation_dim]`."""
        given = self._layout(options or {})
        if mask is not None:
            given["_reset"] = torch.from_numpy(mask.copy()).to(self.env.device).unsqueeze(-1)
        if seed is not None:
            if options:
                # Refuse an invalid layout before the seed changes anything.
                self.env.reset(given.clone())
            self.env.set_seed(seed, static_seed=True)
        self.is_reset = True
        return to_numpy(self.env.reset(given)[keys.OBSERVATION])

    def step(self, action: Any, ignored: np.ndarray | None = None) -> TensorDictBase:
        """Press a key in every boat and return the next state of BoatDockEnv; `ignored` rows may hold any action."""
        if not self.is_reset:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        leaves = self._leaves(action)
        if ignored is not None:
            for leaf in leaves.values():
                leaf[torch.from_numpy(ignored)] = 0
        td = TensorDict(batch_size=self.env.batch_size, device=self.env.device)
        td[keys.DISCRETE] = leaves["key"]
        td[keys.PARAMETERS] = leaves["duration"]
        if self.env.has_choice:
            td[keys.OPTION] = leaves["option"]
        return self.env.step(td)["next"]

    def infos(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the infos, `[N]` each, and which boats are done; `score` is meaningless for the others."""
        state = self.env.state
        fuel = state.fuel / physics.TANK
        values = {
            "outcome": np.array(physics.OUTCOMES, dtype=object)[to_numpy(state.outcome)],
            "fuel": to_numpy(fuel).astype(np.float64),
            "presses": to_numpy(state.presses).astype(np.int64),
            "controller": to_numpy(state.controller).astype(np.int64),
            "score": to_numpy(harbour.score(state.outcome, fuel)).astype(np.float64),
        }
        return values, to_numpy(state.outcome != physics.SAILING)

    def _layout(self, options: Mapping[str, Any]) -> TensorDict:
        """Check the options of a reset and return them as tensors."""
        unknown = set(options) - set(_OPTION_SHAPES)
        if unknown:
            raise ValueError(f"reset: unknown options {sorted(unknown)}; allowed: {', '.join(_OPTION_SHAPES)}")
        missing = {"start", "goal"} - set(options)
        if options and missing:
            raise ValueError(f"reset: options {sorted(options)} lack {sorted(missing)}: a layout has both points")
        given = {}
        for name, value in options.items():
            shape = _OPTION_SHAPES[name]
            given[name] = self._tensor(f"reset: {name}", value, shape, is_integer=shape == ())
        return TensorDict(given, batch_size=[self.env.num_envs], device=self.env.device)

    def _leaves(self, action: Any) -> dict[str, torch.Tensor]:
        """Check the structure, types and shapes of an action and return its leaves, `[N, ...]` each."""
        names = ", ".join(self._leaf_names)
        if self._is_tuple:
            if not isinstance(action, (tuple, list)) or len(action) != len(self._leaf_names):
                raise ValueError(f"step: the action must be a tuple ({names}), but is {describe(action)}")
            action = dict(zip(self._leaf_names, action, strict=True))
            durations = action["duration"]
            if not isinstance(durations, (tuple, list)) or len(durations) != harbour.NUM_KEYS:
                allowed = f"a tuple of length {harbour.NUM_KEYS}"
                raise ValueError(f"step: duration must be {allowed}, but is {describe(durations)}")
            action["duration"] = np.concatenate(
                [as_array("step: duration", d, (*self._batch, 1)) for d in durations], axis=-1
            )
        elif not isinstance(action, Mapping) or set(action) != set(self._leaf_names):
            raise ValueError(f"step: the action must be a dict with keys {names}, but is {describe(action)}")
        leaves = {"duration": self._tensor("step: duration", action["duration"], (harbour.NUM_KEYS,))}
        for name in self._leaf_names[:-1]:
            leaves[name] = self._tensor(f"step: {name}", action[name], (), is_integer=True)
        return leaves

    def _tensor(self, name: str, value: Any, shape: tuple[int, ...], is_integer: bool = False) -> torch.Tensor:
        array = as_array(name, value, self._batch + shape, is_integer=is_integer).astype(
            np.int64 if is_integer else np.float64
        )
        tensor = torch.from_numpy(array).reshape(self.env.num_envs, *shape)
        return tensor if is_integer else tensor.to(torch.float32)
