"""Environments with the interface that Gymnasium's predecessor `gym` had, as Gymnasium environments."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

_ADVICE = "an environment with Gymnasium's interface must inherit from gymnasium.Env"


class FourValueEnv(gymnasium.Env):
    """An environment whose `reset` returns the observation alone and whose `step` returns four values.

    `done` is a time limit, hence truncated, where the info has a true `TimeLimit.truncated`, else terminated. A seed
    goes to the environment's `seed` method or, where it has none, to `reset` if that takes one; else it has no effect.
    Of its spaces only the attributes are read, so that the `gym` package is not needed.

    `shimmy` (`GymV21CompatibilityV0`, `GymV26CompatibilityV0`) does the same with that package installed, and is also
    the way in for environments of `gym` 0.26, whose `step` returns five values.

    Args:
        env: has `reset`, `step`, `action_space` and `observation_space`.

    Raises:
        ValueError: it lacks one of these, one of its spaces is unknown, or `reset` or `step` returns something else.
    """

    def __init__(self, env: Any) -> None:
        missing = [name for name in ("reset", "step", "action_space", "observation_space") if not hasattr(env, name)]
        if missing:
            raise ValueError(f"FourValueEnv: {_kind(env)} is no environment: it has no {', '.join(missing)}")
        self.env = env
        self.spec = getattr(env, "spec", None)
        self.metadata = getattr(env, "metadata", {})
        self.render_mode = getattr(env, "render_mode", None)
        self.action_space = to_gymnasium(env.action_space)
        self.observation_space = to_gymnasium(env.observation_space)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode; there are no options."""
        super().reset(seed=seed)
        seeding = {}
        if seed is not None and hasattr(self.env, "seed"):
            self.env.seed(seed)
        elif seed is not None and "seed" in inspect.signature(self.env.reset).parameters:
            seeding = {"seed": seed}
        observation = self.env.reset(**seeding)
        is_pair = isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict)
        if is_pair and not isinstance(self.observation_space, spaces.Tuple):
            raise ValueError(f"FourValueEnv: reset of {_kind(self.env)} returned an info, too; {_ADVICE}")
        return observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Do an action and tell a time limit from an end."""
        values = self.env.step(action)
        if len(values) != 4:
            raise ValueError(f"FourValueEnv: step of {_kind(self.env)} returned {len(values)} values, not 4; {_ADVICE}")
        observation, reward, done, info = *values[:3], values[3] or {}
        is_truncated = bool(done) and bool(info.get("TimeLimit.truncated", False))
        return observation, reward, bool(done) and not is_truncated, is_truncated, info

    def render(self) -> Any:
        """Return the environment's own picture."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        if hasattr(self.env, "close"):
            self.env.close()


def to_gymnasium(space: Any) -> spaces.Space:
    """Return Gymnasium's form of a space that has the attributes of `gym`'s.

    Raises:
        ValueError: it is no Box, Discrete, MultiDiscrete, MultiBinary, Tuple or Dict.
    """
    if isinstance(space, spaces.Space):
        return space
    if hasattr(space, "spaces"):
        if isinstance(space.spaces, Mapping):
            # A list, because the names of a dict would be sorted.
            return spaces.Dict([(name, to_gymnasium(part)) for name, part in space.spaces.items()])
        return spaces.Tuple([to_gymnasium(part) for part in space.spaces])
    if hasattr(space, "low") and hasattr(space, "high"):
        dtype = getattr(space, "dtype", None) or np.float32
        return spaces.Box(np.asarray(space.low, dtype), np.asarray(space.high, dtype), dtype=dtype)
    if hasattr(space, "nvec"):
        return spaces.MultiDiscrete(np.asarray(space.nvec))
    if hasattr(space, "n"):
        # A MultiBinary has an `n`, too, and a shape.
        if getattr(space, "shape", None):
            return spaces.MultiBinary(space.n)
        return spaces.Discrete(int(space.n), start=int(getattr(space, "start", 0)))
    raise ValueError(f"FourValueEnv: {_kind(space)} is no space that is known: a Box, Discrete, Tuple or Dict")


def _kind(value: Any) -> str:
    return f"{type(value).__module__}.{type(value).__qualname__}"
