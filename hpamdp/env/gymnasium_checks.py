"""Checks of what Gymnasium environments take: actions, options of a reset, ways of drawing.

Nothing here needs torch, which takes seconds to import.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hpamdp.settings import SettingError


def as_array(name: str, value: Any, shape: tuple[int, ...], *, is_integer: bool = False) -> np.ndarray:
    """Return a value as an array.

    Raises:
        ValueError: it is no array of this shape and kind; the message calls it `name`.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be an array, but is {describe(value)}") from None
    if array.dtype.kind not in ("iu" if is_integer else "iuf"):
        raise ValueError(f"{name} has type {array.dtype}, but must be {'integer' if is_integer else 'a number'}")
    if array.shape != shape:
        raise ValueError(f"{name} has shape {list(array.shape)}, but must be {list(shape)}")
    return array


def describe(value: Any) -> str:
    """Return what a value is, for an error."""
    kind = type(value).__name__
    if isinstance(value, Mapping):
        return f"a {kind} with keys {', '.join(map(str, value))}"
    if isinstance(value, (tuple, list)):
        return f"a {kind} of length {len(value)}"
    return f"a {kind}"


def parameter_arrays(
    parameters: Any,
    parameter_dims: Sequence[int],
    batch: tuple[int, ...],
    where: str = "step",
    name: str = "parameters",
) -> list[np.ndarray]:
    """Return the parameters of each discrete action, `[*batch, dim]` each.

    Args:
        parameters: a tuple with those of each discrete action.
        parameter_dims: number of parameters of each discrete action.
        batch: `()` for one environment, `(N,)` for many.
        where: begins the error.
        name: of the parameters in the error.

    Raises:
        ValueError: it is no such tuple.
    """
    if not isinstance(parameters, (tuple, list)) or len(parameters) != len(parameter_dims):
        num = len(parameter_dims)
        raise ValueError(f"{where}: {name} must be a tuple of length {num}, but is {describe(parameters)}")
    return [
        as_array(f"{where}: {name} of action {number}", array, (*batch, dim))
        for number, (array, dim) in enumerate(zip(parameters, parameter_dims, strict=True))
    ]


def single_action(action: Any, parameter_dims: Sequence[int], where: str = "step") -> tuple[int, np.ndarray]:
    """Return the discrete action that one Gymnasium environment takes, and its own parameters, `[dim]`.

    Args:
        action: a tuple of the discrete action and a tuple with the parameters of each one.
        parameter_dims: number of parameters of each discrete action.
        where: begins the error.

    Raises:
        ValueError: it is no such tuple, there is no such discrete action, or its parameters are not finite.
    """
    if not isinstance(action, (tuple, list)) or len(action) != 2:
        raise ValueError(f"{where}: the action must be a tuple (discrete, parameters), but is {describe(action)}")
    number = int(as_array(f"{where}: discrete", action[0], (), is_integer=True))
    if not 0 <= number < len(parameter_dims):
        raise ValueError(f"{where}: discrete={number}, but allowed are 0 to {len(parameter_dims) - 1}")
    own = parameter_arrays(action[1], parameter_dims, (), where)[number]
    if not np.isfinite(own).all():
        raise ValueError(f"{where}: the parameters of action {number} are {own}, but must be finite")
    return number, own


def reset_options(options: Any, allowed: Sequence[str] | None = ()) -> dict[str, Any]:
    """Return a copy of the options of a reset.

    Args:
        options: the options, or None.
        allowed: their names; if None, the environment checks them itself.

    Raises:
        ValueError: they are no mapping, or one has an unknown name.
    """
    if not isinstance(options, Mapping | None):
        raise ValueError(f"reset: options must be a dict, but is {describe(options)}")
    given = dict(options or {})
    unknown = [] if allowed is None else [name for name in given if name not in allowed]
    if unknown:
        there_are = f"allowed: {', '.join(allowed)}" if allowed else "there are none"
        raise ValueError(f"reset: unknown options {unknown}; {there_are}")
    return given


def check_render_mode(name: str, render_mode: Any) -> None:
    """Refuse a way of drawing but None and `rgb_array`.

    Raises:
        SettingError: `render_mode` is neither None nor `rgb_array`.
    """
    if render_mode not in (None, "rgb_array"):
        raise SettingError(f"{name}: render_mode={render_mode!r}, but must be None or rgb_array")
