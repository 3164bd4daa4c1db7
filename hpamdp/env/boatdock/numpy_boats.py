"""BoatDockEnv spoken to in numpy: Gymnasium's spaces, and the checks between its actions and our tensors.

Action formats, for one boat (batched spaces are Gymnasium's own, every leaf with a leading `[N]`):

- `dict`: `{"key": 0..2, "duration": [3] seconds in [0, 2], one a key, only the pressed key's counts}`, and with
  `controller="choose"` also `"option": 0 (incongruent) or 1 (congruent)`, read at an episode's first press.
- `tuple`, the field's convention: `(key, (seconds [1], seconds [1], seconds [1]))`, and with `controller="choose"` the
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
from hpamdp.env.boatdock.episode import OBSERVATION_NAMES, SCALED_NAMES, Rules

ActionFormat = Literal["dict", "tuple"]

_OPTION_SHAPES = {"start": (2,), "goal": (2,), "controller": (), "keymap": ()}
# Gaussian numbers made from 23-bit uniform ones stay within 5.8 standard deviations.
_LARGEST_NORMAL = 6.0


def action_space(has_choice: bool, action_format: ActionFormat) -> spaces.Dict | spaces.Tuple:
    """Return one boat's action space; see the module's docstring."""
    num_discrete, longest = harbour.NUM_KEYS, physics.MAX_DURATION
    option = spaces.Discrete(len(harbour.CONTROLLERS))
    if action_format == "dict":
        press = {"key": spaces.Discrete(num_discrete), "duration": spaces.Box(0.0, longest, (num_discrete,))}
        return spaces.Dict({"option": option, **press} if has_choice else press)
    durations = spaces.Tuple([spaces.Box(0.0, longest, (1,)) for _ in range(num_discrete)])
    press = (spaces.Discrete(num_discrete), durations)
    return spaces.Tuple((option, *press) if has_choice else press)


def observation_space(rules: Rules) -> spaces.Box:
    """Return one boat's observation space: float32 with the finite bounds that layouts, motion and noise leave."""
    is_pixels = rules.observation == "pixels"
    unit = 1.0 if is_pixels else 1.0 / physics.HARBOUR_RADIUS
    top_speed = 1.01 * (float(physics.speed(torch.tensor(physics.MAX_DURATION))) if is_pixels else 1.0)
    # A px more than the geometry allows, for rounding.
    reach = physics.HARBOUR_RADIUS + 1.0 + _LARGEST_NORMAL * rules.sensor_noise
    bounds = {
        "radius": (0.0, 2.0 * physics.HARBOUR_RADIUS * unit),
        "controller": (-1.0, 1.0),
        "fuel": (0.0, 1.0),
        # In units of the distance at the start, which counts as a dock's radius at least.
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


class NumpyBoats:
    """BoatDockEnv spoken to in numpy: one boat (`batch=()`) or many (`batch=(N,)`)."""

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

    def reset(self, seed: int | None, options: Mapping[str, Any] | None, mask: np.ndarray | None = None) -> np.ndarray:
        """Start new episodes (in the rows of `mask`, default all) and return the observations `[N, obs]`."""
        given = self._layout(options or {})
        if mask is not None:
            given["_reset"] = torch.from_numpy(mask.copy()).to(self.env.device).unsqueeze(-1)
        if seed is not None:
            if options:
                # Refuses a bad layout while the boats are still as they were.
                self.env.reset(given.clone())
            self.env.set_seed(seed, static_seed=True)
        self.is_reset = True
        return to_numpy(self.env.reset(given)[keys.OBSERVATION])

    def step(self, action: Any, ignored: np.ndarray | None = None) -> TensorDictBase:
        """Press a key in every boat and return what BoatDockEnv does; in `ignored` rows any action passes."""
        if not self.is_reset:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        leaves = self._leaves(action)
        if ignored is not None:
            for leaf in leaves.values():
                leaf[torch.from_numpy(ignored)] = 0
        n = self.env.num_envs
        option = {keys.OPTION: leaves["option"]} if self.env.has_choice else {}
        press = TensorDict(discrete=leaves["key"], parameters=leaves["duration"], batch_size=[n])
        return self.env.step(TensorDict({**option, keys.ACTION: press}, batch_size=[n], device=self.env.device))["next"]

    def infos(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return the info values, `[N]` each (`score` means nothing before the end), and which boats are done."""
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
        """Check an action's structure, types and shapes and return its leaves, `[N, ...]` each."""
        names = ", ".join(self._leaf_names)
        if self._is_tuple:
            if not isinstance(action, (tuple, list)) or len(action) != len(self._leaf_names):
                raise ValueError(f"step: the action must be a tuple ({names}), but is {_describe(action)}")
            action = dict(zip(self._leaf_names, action, strict=True))
            durations = action["duration"]
            if not isinstance(durations, (tuple, list)) or len(durations) != harbour.NUM_KEYS:
                allowed = f"a tuple of length {harbour.NUM_KEYS}"
                raise ValueError(f"step: duration must be {allowed}, but is {_describe(durations)}")
            action["duration"] = np.concatenate([self._array("step: duration", d, (1,)) for d in durations], axis=-1)
        elif not isinstance(action, Mapping) or set(action) != set(self._leaf_names):
            raise ValueError(f"step: the action must be a dict with keys {names}, but is {_describe(action)}")
        leaves = {"duration": self._tensor("step: duration", action["duration"], (harbour.NUM_KEYS,))}
        for name in self._leaf_names[:-1]:
            leaves[name] = self._tensor(f"step: {name}", action[name], (), is_integer=True)
        return leaves

    def _tensor(self, name: str, value: Any, shape: tuple[int, ...], is_integer: bool = False) -> torch.Tensor:
        array = self._array(name, value, shape, is_integer).astype(np.int64 if is_integer else np.float64)
        tensor = torch.from_numpy(array).reshape(self.env.num_envs, *shape)
        return tensor if is_integer else tensor.to(torch.float32)

    def _array(self, name: str, value: Any, shape: tuple[int, ...], is_integer: bool = False) -> np.ndarray:
        try:
            array = np.asarray(value)
        except (TypeError, ValueError):
            raise ValueError(f"{name} is no array, but {_describe(value)}") from None
        if array.dtype.kind not in ("iu" if is_integer else "iuf"):
            raise ValueError(f"{name} has type {array.dtype}, but must be {'integer' if is_integer else 'a number'}")
        if array.shape != self._batch + shape:
            raise ValueError(f"{name} has shape {list(array.shape)}, but must be {list(self._batch + shape)}")
        return array


def _describe(value: Any) -> str:
    kind = type(value).__name__
    if isinstance(value, Mapping):
        return f"a {kind} with keys {', '.join(map(str, value))}"
    return f"a {kind} of length {len(value)}" if isinstance(value, (tuple, list)) else f"a {kind}"


def to_numpy(tensor: torch.Tensor) -> np.ndarray:
    """Copy a tensor into an array of its own, so that nobody who holds it sees or makes a change."""
    return tensor.cpu().numpy().copy()
