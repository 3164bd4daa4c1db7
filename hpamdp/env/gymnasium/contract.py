"""Gymnasium's contract of `reset` and `step`, checked at every call: what breaks it is told in one line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium

from hpamdp.env.errors import ProblemError, fault_of
from hpamdp.env.gymnasium.values import flag, number, shown
from hpamdp.messages import one_line, warn
from hpamdp.settings import SettingError

_STATISTICS = ("mean", "var", "count")


class ContractCheck(gymnasium.Wrapper):
    """Pass on what an environment returns, after a check of its form; rewards are floats, flags are bool.

    `gymnasium.wrappers.PassiveEnvChecker` checks the spaces of the values, too, but answers with warnings, and with
    assertions of several lines.

    Raises:
        ProblemError: from `reset` and `step`, if these break their contract.
    """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode and return its first observation and an info."""
        try:
            values: Any = self.env.reset(seed=seed, options=options)
        except TypeError as error:
            if not _is_about_the_call(error):
                raise
            raise ProblemError(f"reset must take seed and options: {one_line(error)}") from error
        if not isinstance(values, tuple) or len(values) != 2 or not isinstance(values[1], Mapping):
            raise ProblemError("reset must return an observation and an info, a dictionary")
        return values[0], dict(values[1])

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step."""
        try:
            values: Any = self.env.step(action)
        except TypeError as error:
            refuse_step(error)
            raise
        return checked_step(values)

    def close(self) -> None:
        """Close the environment; if it raises an error, warn and let the run go on."""
        what = f"{type(self.unwrapped).__name__}: close"
        try:
            self.env.close()
        except Exception as error:
            told = fault_of(error, what) or f"{what} raised {type(error).__name__}: {error}"
            warn(one_line(f"{told}; the run goes on"))


def refuse_step(error: TypeError) -> None:
    """Explain an error of `step` if it breaks the contract; call this in the frame that called `step`.

    Raises:
        ProblemError: `step` does not take an action.
    """
    if _is_about_the_call(error):
        raise ProblemError(f"step must take an action: {one_line(error)}") from error


def checked_step(values: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """Return what a step returned, after a check of its form; the reward is a float, and the flags are bool.

    Raises:
        ProblemError: the values break the contract.
    """
    if not isinstance(values, tuple) or len(values) != 5:
        given = f"{len(values)} values" if isinstance(values, tuple) else type(values).__name__
        raise ProblemError(f"step returned {given}, not observation, reward, terminated, truncated and info")
    observation, reward, terminated, truncated, info = values
    # The types that a step usually returns need no call, which takes longer than all of these comparisons.
    if type(info) is not dict:
        if not isinstance(info, Mapping):
            raise ProblemError(f"step returned {shown(info)} as info, which must be a dictionary")
        info = dict(info)
    if type(reward) is not float:
        reward = number("reward", reward)
    if type(terminated) is not bool:
        terminated = flag("terminated", terminated)
    if type(truncated) is not bool:
        truncated = flag("truncated", truncated)
    return observation, reward, terminated, truncated, info


def _is_about_the_call(error: TypeError) -> bool:
    """Return whether a method does not take its arguments: the error was raised before its first line."""
    assert error.__traceback__ is not None
    return error.__traceback__.tb_next is None


def refuse_running_statistics(env: gymnasium.Env) -> None:
    """Refuse a wrapper that normalises by running statistics, which differ between copies and move in evaluations.

    Raises:
        SettingError: there is one whose statistics are not frozen by `update_running_mean`.
    """
    layer = env
    while isinstance(layer, gymnasium.Wrapper):
        parts = [layer, *(part for part in vars(layer).values() if not isinstance(part, gymnasium.Env))]
        # As in the statistics of Gymnasium, Stable-Baselines3 and others; arrays have methods of these names.
        has_some = any(all(not callable(getattr(part, name, print)) for name in _STATISTICS) for part in parts)
        if has_some and getattr(layer, "update_running_mean", True):
            raise SettingError(
                f"{type(layer).__name__}: its running statistics would differ between copies and move in evaluations, "
                "whose scores would be wrong; leave it out, and set env.observation_scaling=running for observations, "
                "env.reward_scaling=0.99 for rewards"
            )
        layer = layer.env


def checked(env: gymnasium.Env) -> gymnasium.Env:
    """Put a ContractCheck around the environment and, if it has wrappers, around the environment inside them.

    Wrappers unpack the values of the inner environment before the outer check sees them.
    """
    outer = env
    while isinstance(outer, gymnasium.Wrapper):
        if not isinstance(outer.env, gymnasium.Wrapper):
            outer.env = ContractCheck(outer.env)
            break
        outer = outer.env
    return ContractCheck(env)
