"""The time limit of a Gymnasium environment: its own or the one given."""

from __future__ import annotations

import gymnasium
from gymnasium.wrappers import TimeLimit

from hpamdp.settings import SettingError


def limit_of(env: gymnasium.Env, max_steps: int | None) -> int | None:
    """Return the number of steps after which an episode of the environment is truncated; None if nothing names one.

    Args:
        env: its own limit is the lowest one of its TimeLimit wrappers and, in a problem of this package, of the
            problem. An environment without these has the limit of its spec.
        max_steps: a limit of at most the environment's own. If None, the latter.

    Raises:
        SettingError: `max_steps` is above the environment's own limit.
    """
    limits = _applied_limits(env)
    own = getattr(env.unwrapped, "own_time_limit", None)  # of this package's problems, which end their episodes
    if own is not None:
        limits.append(own)
    if max_steps is None:
        return min(limits) if limits else _limit_of_spec(env)
    if limits and min(limits) < max_steps:
        raise SettingError(
            f"max_steps={max_steps}: the environment ends its episodes after {min(limits)}; give less or null"
        )
    return max_steps


def _applied_limits(env: gymnasium.Env) -> list[int]:
    limits = []
    layer = env
    while isinstance(layer, gymnasium.Wrapper):
        if isinstance(layer, TimeLimit):
            limits.append(layer._max_episode_steps)
        layer = layer.env
    return limits


def _limit_of_spec(env: gymnasium.Env) -> int | None:
    limit = getattr(env.unwrapped.spec, "max_episode_steps", None)
    return None if limit is None or limit < 1 else int(limit)  # `gymnasium.make` takes -1 as no limit
