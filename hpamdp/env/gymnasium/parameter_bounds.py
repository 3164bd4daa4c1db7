"""Bounds of the parameters that a Gymnasium environment gives in every state, and how an agent observes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from hpamdp import keys
from hpamdp.env.errors import ProblemError
from hpamdp.env.gymnasium.action_spaces import ActionSpace
from hpamdp.env.gymnasium.options import MaskSource
from hpamdp.env.gymnasium.values import MisfitError
from hpamdp.settings import SettingError

_NAMES = (keys.PARAMETER_LOW, keys.PARAMETER_HIGH)
# A bound may exceed those of the space by this fraction of their size. It is then clipped, as a rounding error.
_ROUNDING = 4.0 * float(np.finfo(np.float32).eps)


class ParameterBounds:
    """The bounds of the copies of an environment, which change with the state.

    Args:
        env: one of the copies.
        num_envs: number of copies.
        actions: their action space, without the option.
        first_info: of a reset.
        source: `info`: the bounds come with the info of every reset and step; `ignore`: they are not read. If None,
            they are entries of the observation, a `Dict`, or of the first info, if these have them.

    Attributes:
        names: those of `parameter_low` and `parameter_high` that are read; empty if the environment gives neither.
        in_observation: whether they come with the observation.
        low, high: the bounds of the space's own parameters, float64 `[N, num_parameters]`.

    Raises:
        ValueError: there are no parameters.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        num_envs: int,
        actions: ActionSpace,
        first_info: Mapping[str, Any],
        source: MaskSource | None,
    ) -> None:
        space = env.observation_space
        entries = space.spaces if isinstance(space, spaces.Dict) and source is None else {}
        self.names = tuple(name for name in _NAMES if source == "info" or name in entries)
        if self.names and not any(actions.parameter_dims):
            raise SettingError(f"{' and '.join(self.names)}: the action has no parameters")
        self.in_observation = source is None and bool(self.names)
        if source is None and not self.names and any(actions.parameter_dims):
            self.names = tuple(name for name in _NAMES if first_info.get(name) is not None)
        self._may_be_unread = source is None and not self.names and any(actions.parameter_dims)
        self._actions = actions
        self._has_whole = bool(actions.is_whole.any())
        self.low = np.tile(actions.own_low, (num_envs, 1))
        self.high = np.tile(actions.own_high, (num_envs, 1))

    def keep(self, row: int, observation: Any, info: Mapping[str, Any]) -> None:
        """Keep the bounds that one copy gives with a reset or a step.

        Args:
            row: the copy's number.
            observation: as the environment gives it.
            info: as the environment gives it.

        Raises:
            ProblemError: the bounds are missing, have another structure than the space, or are not read. Or a bound is
                not finite or whole, lies outside the bounds of the space, or crosses the other one.
        """
        if self._may_be_unread:
            self._refuse_unread(info)
        if not self.names:
            return
        source = observation if self.in_observation else info
        given = {name: source.get(name) for name in self.names}
        if all(value is None for value in given.values()):
            raise ProblemError(
                f"gave no {' or '.join(self.names)}, which must come with every reset and step; "
                "env.parameter_bounds=ignore ignores bounds"
            )
        lowest, highest = self._actions.own_low, self._actions.own_high
        low = self._read(keys.PARAMETER_LOW, given, lowest)
        high = self._read(keys.PARAMETER_HIGH, given, highest)
        # The quick way for what almost every step gives. Otherwise the full checks say what is wrong.
        is_usual = not self._has_whole and ((lowest <= low) & (low <= high) & (high <= highest)).all()
        if not is_usual:
            low, high = self._checked(keys.PARAMETER_LOW, low), self._checked(keys.PARAMETER_HIGH, high)
            self._refuse_where(low > high, keys.PARAMETER_LOW, low, "above parameter_high={}", high)
        self.low[row], self.high[row] = low, high

    @staticmethod
    def _refuse_unread(info: Mapping[str, Any]) -> None:
        for name in _NAMES:
            if info.get(name) is not None:
                raise ProblemError(
                    f"gave info[{name!r}], which is not read; give bounds of the state as parameter_low and "
                    "parameter_high in a Dict of observations, or in the info of every reset and step with "
                    "env.parameter_bounds=info; env.parameter_bounds=ignore ignores them"
                )

    def _read(self, name: str, given: Mapping[str, Any], static: np.ndarray) -> np.ndarray:
        """Return the numbers of a bound, or those of the space if the bound is not given."""
        bound = given.get(name)
        try:
            return static if bound is None else self._actions.read_bounds(bound, static)
        except MisfitError as error:
            raise error.named(name, bound) from error

    def _checked(self, name: str, bound: np.ndarray) -> np.ndarray:
        """Return a bound within those of the space."""
        actions = self._actions
        self._refuse_where(~np.isfinite(bound), name, bound, "which is not finite")
        self._refuse_where(actions.is_whole & (bound != np.rint(bound)), name, bound, "but the parameter is whole")
        low, high = actions.own_low, actions.own_high
        slack = np.where(actions.is_whole, 0.0, _ROUNDING * np.maximum(np.abs(low), np.abs(high)))
        is_outside = (bound < low - slack) | (bound > high + slack)
        self._refuse_where(is_outside, name, bound, "outside the action space: {} to {}", low, high)
        return bound.clip(low, high)

    @staticmethod
    def _refuse_where(is_wrong: np.ndarray, name: str, bound: np.ndarray, why: str, *others: np.ndarray) -> None:
        if is_wrong.any():
            place = int(is_wrong.argmax())
            reason = why.format(*(f"{other[place]:.10g}" for other in others))
            raise ProblemError(f"gave {name}={bound[place]:.10g} for parameter {place}, {reason}")


def agent_bounds(actions: ActionSpace, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the bounds of the agent's parameters, and the numbers by which it observes them.

    Args:
        actions: the action space.
        low, high: the bounds of the space's own parameters, float64 `[N, num_parameters]` each.

    Returns:
        The lower and the upper bounds of the agent's parameters, float32 `[N, num_parameters]` each. They are rounded
        inwards, so every float32 between them is within the exact bounds. If no float32 lies between these, both are
        the smallest one above the lower bound. Last, all lower and all upper bounds as the agent observes them, float32
        `[N, 2 num_parameters]`: scaled so that the bounds of the space are -1 and 1.
    """
    exact = actions.map.parameters(low), actions.map.parameters(high)
    width = actions.high.astype(np.float64) - actions.low
    lowest, highest = (side.astype(np.float32) for side in exact)
    lowest = np.where(lowest < exact[0], np.nextafter(lowest, np.float32(np.inf)), lowest)
    highest = np.where(highest > exact[1], np.nextafter(highest, np.float32(-np.inf)), highest)
    is_crossed = lowest > highest  # no float32 lies between the exact bounds
    lowest = np.where(low <= actions.own_low, actions.low, lowest)
    highest = np.where(high >= actions.own_high, actions.high, highest)
    lowest, highest = (side.clip(actions.low, actions.high) for side in (lowest, highest))
    highest = np.where(is_crossed | (lowest > highest), lowest, highest)
    # Equal bounds look equal, see `PAMDPEnv.bounds_place`.
    observed = exact[0], np.where(lowest == highest, exact[0], exact[1])
    seen = np.concatenate([2.0 * (side - actions.low) / width - 1.0 for side in observed], axis=-1)
    return lowest, highest, seen.clip(-1.0, 1.0).astype(np.float32)
