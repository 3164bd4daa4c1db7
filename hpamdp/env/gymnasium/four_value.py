"""Environments with the interface of `gym`, Gymnasium's predecessor, as Gymnasium environments."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from hpamdp.env.errors import ProblemError
from hpamdp.env.gymnasium.values import flag, shown
from hpamdp.settings import SettingError

_ADVICE = "an environment with Gymnasium's interface must inherit from gymnasium.Env"


class FourValueEnv(gymnasium.Env):
    """Wrap an environment whose `reset` returns only the observation and whose `step` returns four values.

    If `done` is true, the step is truncated if the info has a true `TimeLimit.truncated`, else terminated. A seed is
    passed to the environment's `seed` method. Without this method it is passed to `reset`, if that takes a seed. Only
    the attributes of the spaces are read, so the `gym` package is not needed.

    `shimmy` (`GymV21CompatibilityV0`, `GymV26CompatibilityV0`) does the same with `gym` installed, and also wraps the
    environments of `gym` 0.26, whose `step` returns five values.

    Args:
        env: has `reset`, `step`, `action_space` and `observation_space`.

    Raises:
        ValueError: one of these is missing, a space is of an unknown kind, or `reset` or `step` returns something else.
    """

    def __init__(self, env: Any) -> None:
        missing = [name for name in ("reset", "step", "action_space", "observation_space") if not hasattr(env, name)]
        if missing:
            raise SettingError(f"{_kind(env)} is no environment: it has no {', '.join(missing)}")
        self.env = env
        self.spec = getattr(env, "spec", None)
        self.metadata = getattr(env, "metadata", {})
        self.render_mode = getattr(env, "render_mode", None)
        self.action_space = to_gymnasium(env.action_space)
        self.observation_space = to_gymnasium(env.observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; `options` are ignored, and the info is empty."""
        super().reset(seed=seed)
        arguments = {}
        if seed is not None:
            if hasattr(self.env, "seed"):
                self.env.seed(seed)
            elif "seed" in inspect.signature(self.env.reset).parameters:
                arguments["seed"] = seed
        observation = self.env.reset(**arguments)
        has_info = isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict)
        if has_info and not isinstance(self.observation_space, spaces.Tuple):
            raise ProblemError(f"FourValueEnv: reset of {_kind(self.env)} returned an info, too; {_ADVICE}")
        return observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step and split `done` into `terminated` and `truncated`."""
        values = self.env.step(action)
        if not isinstance(values, tuple | list) or len(values) != 4:
            given = f"{len(values)} values" if isinstance(values, tuple | list) else type(values).__name__
            raise ProblemError(f"FourValueEnv: step of {_kind(self.env)} returned {given}, not 4; {_ADVICE}")
        observation, reward, done, info = values
        if not isinstance(info, Mapping | None):
            raise ProblemError(f"step returned {shown(info)} as info, which must be a dictionary")
        info = dict(info or {})
        is_over = flag("done", done)
        is_truncated = is_over and flag("info['TimeLimit.truncated']", info.get("TimeLimit.truncated", False))
        return observation, reward, is_over and not is_truncated, is_truncated, info

    def render(self) -> Any:
        """Return what the environment's own `render` returns."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        if hasattr(self.env, "close"):
            self.env.close()


def to_gymnasium(space: Any) -> spaces.Space:
    """Return the Gymnasium space with the attributes of a `gym` space.

    Raises:
        ValueError: the space is no Box, Discrete, MultiDiscrete, MultiBinary, Tuple or Dict.
    """
    if isinstance(space, spaces.Space):
        return space
    for attributes, convert in _CONVERSIONS:
        if all(hasattr(space, attribute) for attribute in attributes):
            return convert(space)
    raise SettingError(
        f"FourValueEnv: {_kind(space)} is no known space: "
        "accepted are Box, Discrete, MultiDiscrete, MultiBinary, Tuple and Dict"
    )


def _tuple_or_dict(space: Any) -> spaces.Space:
    if isinstance(space.spaces, Mapping):
        # A list keeps the order; the names of a dict would be sorted.
        return spaces.Dict([(name, to_gymnasium(part)) for name, part in space.spaces.items()])
    return spaces.Tuple([to_gymnasium(part) for part in space.spaces])


def _box(space: Any) -> spaces.Space:
    dtype = getattr(space, "dtype", None) or np.float32
    return spaces.Box(np.asarray(space.low, dtype), np.asarray(space.high, dtype), dtype=dtype)


def _multi_discrete(space: Any) -> spaces.Space:
    return spaces.MultiDiscrete(np.asarray(space.nvec))


def _discrete_or_multi_binary(space: Any) -> spaces.Space:
    # Both have `n`; only a MultiBinary has a shape that is not empty.
    if getattr(space, "shape", None):
        return spaces.MultiBinary(space.n)
    return spaces.Discrete(int(space.n), start=int(getattr(space, "start", 0)))


# The attributes by which a kind of space is recognised; the first match counts.
_CONVERSIONS: tuple[tuple[tuple[str, ...], Callable[[Any], spaces.Space]], ...] = (
    (("spaces",), _tuple_or_dict),
    (("low", "high"), _box),
    (("nvec",), _multi_discrete),
    (("n",), _discrete_or_multi_binary),
)


def _kind(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"
