"""Gymnasium's continuous LunarLander with an action that says which engines fire, and how strongly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from hpamdp.env.gymnasium_checks import check_render_mode, describe, reset_options, single_action
from hpamdp.env.lunar_lander.options import LanderRules
from hpamdp.settings import SettingError

SOLVED = 200.0
"""Return from which Gymnasium counts an episode as solved."""

_NONE = spaces.Box(0.0, 1.0, (0,), np.float32)
_THROTTLE = spaces.Box(0.5, 1.0, (1,), np.float32)
# The dynamics switch an engine off at 0 (main) and at 0.5 (side), so the lowest throttles lie just above.
_LEAST_MAIN = np.float32(1e-6)
_LEAST_SIDE = np.nextafter(np.float32(0.5), np.float32(1.0))
_DIMS = {"main": (0, 1), "side": (0, 1, 1)}  # parameters of each discrete action
_SIDES = (0.0, -1.0, 1.0)  # signs of off, left and right in LunarLander's action


class HybridLunarLander(gymnasium.Wrapper):
    """Land between two flags with a main engine and two side engines.

    Source: Gymnasium's LunarLanderContinuous-v3, whose dynamics, observations and rewards are unchanged.

    Differs from the source: the action is a `Dict` of two choices that are made at once. The source has a `Box`,
    in which -1 to 0 of the main engine and -0.5 to 0.5 of the side engines mean off.

    - `main`: off, or on with a throttle in [0.5, 1];
    - `side`: off, left or right, with a throttle in [0.5, 1] each.

    The info of a step has `is_success`: whether the return so far is at least 200, which Gymnasium counts as solved.

    Args:
        render_mode: None or `rgb_array`.
        settings: rules that differ from LunarLander's, see `LanderRules`.

    Raises:
        SettingError: an argument is wrong, or Box2D is not installed.
    """

    def __init__(self, *, render_mode: str | None = None, **settings: Any) -> None:
        check_render_mode("HybridLunarLander", render_mode)
        rules = LanderRules.of(None, settings)
        try:
            from gymnasium.envs.box2d.lunar_lander import LunarLander
        except (ImportError, gymnasium.error.DependencyNotInstalled) as error:
            raise SettingError("Box2D is not installed; pip install 'hpamdp[box2d]'") from error
        super().__init__(LunarLander(render_mode=render_mode, continuous=True, **dict(rules)))
        self.action_space = spaces.Dict(
            main=spaces.Tuple([spaces.Discrete(2), spaces.Tuple([_NONE, _THROTTLE])]),
            side=spaces.Tuple([spaces.Discrete(3), spaces.Tuple([_NONE, _THROTTLE, _THROTTLE])]),
        )
        self._return = 0.0
        self._is_over = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        reset_options(options)
        self._return, self._is_over = 0.0, False
        return self.env.reset(seed=seed, options=options)

    def step(self, action: dict[str, Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Fire the engines for a step.

        Raises:
            ValueError: there is no such action, or its throttle is not finite.
            ResetNeeded: no episode has begun, or the last one is over.
        """
        if self._is_over:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        observation, reward, terminated, truncated, info = self.env.step(continuous_action(action))
        self._return += float(reward)
        self._is_over = terminated or truncated
        return observation, float(reward), terminated, truncated, {**info, "is_success": self._return >= SOLVED}

    def close(self) -> None:
        """End the episode; the environment must be reset before it is used again."""
        self._is_over = True
        super().close()


def continuous_action(action: dict[str, Any]) -> np.ndarray:
    """Return the action of LunarLanderContinuous-v3 that fires the same engines equally strongly, float32 `[2]`.

    Raises:
        ValueError: there is no such action, or its throttle is not finite.
    """
    if not isinstance(action, Mapping) or action.keys() != _DIMS.keys():
        raise ValueError(f"step: the action must be a dict with keys {', '.join(_DIMS)}, but is {describe(action)}")
    (main, lifts), (side, pushes) = (single_action(action[name], _DIMS[name], f"step: {name}") for name in _DIMS)
    lift, push = np.float32(-1.0), np.float32(0.0)
    if main:
        lift = max(np.float32(2.0) * np.float32(lifts[0]) - np.float32(1.0), _LEAST_MAIN)
    if side:
        push = np.float32(_SIDES[side]) * max(np.float32(pushes[0]), _LEAST_SIDE)
    return np.array([lift, push], np.float32)


def hybrid_action(action: np.ndarray) -> dict[str, Any]:
    """Return the action of `HybridLunarLander` with the same effect as an action of LunarLanderContinuous-v3."""
    lift, push = np.clip(np.asarray(action, np.float32), -1.0, 1.0)
    main = int(lift > 0.0)
    side = 0 if abs(push) <= 0.5 else 1 + int(push > 0.0)
    of_main = np.array([0.5 * (max(lift, 0.0) + 1.0)], np.float32)
    of_side = np.array([max(abs(push), 0.5)], np.float32)
    none = np.zeros(0, np.float32)
    return {
        "main": (np.int64(main), (none, of_main)),
        "side": (np.int64(side), (none, of_side, of_side)),
    }
