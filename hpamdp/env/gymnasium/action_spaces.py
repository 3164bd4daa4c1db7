"""Gymnasium's parameterised action spaces: discrete actions whose parameters lie side by side in one vector.

Accepted are a `Tuple` that begins with a `Discrete(K)`, the discrete actions, a `Dict` of a `Discrete(K)` and one other
entry, with any names, and a `OneOf` of K boxes. The `Discrete` may have any `start`. The parameters are one of these:

- a `Tuple` of K boxes, one for each discrete action: `Tuple(Discrete(K), Tuple(Box, ...))` is the field's convention. A
  discrete action without parameters has a box of shape `(0,)`. In a `Tuple` the K boxes may also follow the `Discrete`
  directly.
- a `Dict` of K boxes, which belong to the discrete actions in the order of the space (Gymnasium sorts the names of a
  plain dict) or, if all names end in different numbers, in the order of these numbers. The K boxes may also be entries
  beside the `Discrete`: `Dict(mode=Discrete(2), a=Box, b=Box)`, where `a` belongs to the first discrete action.
- one `Box` for all discrete actions. With `parameter_dims` it is split among them, side by side, and always passed as a
  whole. Without, each discrete action takes the whole box: the vector holds one copy for each, and the chosen action's
  copy is passed.

Boxes hold floats with finite bounds, in any shape. An agent's parameters are float32. In some more precise Boxes
float32 cannot resolve a millionth of the width, as with times in seconds since 1970. The agent's parameter then lies in
[-1, 1], and is mapped to the Box in float64.

A space may have one more entry, a `Discrete`: the option, which the agent chooses less often than the action. It is the
entry `option` of a `Dict`, or the entry that `option_key` names. What is left without it has one of the forms above, or
is a single entry that has.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from hpamdp.settings import SettingError

_ACCEPTED = (
    "accepted are Tuple(Discrete(K), P) and a Dict of a Discrete(K) and P, where P is a Tuple or a Dict of K Boxes or "
    "one Box for all discrete actions, Tuple(Discrete(K), Box, ..., Box) and a Dict of a Discrete(K) and K Boxes, and "
    "OneOf(K Boxes)"
)

# Of a parameter, in widths of its Box.
_RESOLUTION = 1e-6


class ActionSpace:
    """A parameterised action space, and the way from a discrete action and its parameters to the space's own format.

    Args:
        space: see the module's docstring.
        parameter_dims: number of parameters that each discrete action takes of one box for all.

    Attributes:
        parameter_dims: number of parameters of each discrete action, K entries.
        low, high: bounds of the agent's parameters, float32 `[sum(parameter_dims)]`.

    Raises:
        ValueError: the space has none of the accepted forms, or its box cannot be split as `parameter_dims` says.
    """

    def __init__(self, space: spaces.Space, parameter_dims: Sequence[int] | None = None) -> None:
        self._space = space
        self._discrete, parameters = self._read_parts()
        num_discrete = int(self._discrete.n)
        self._has_one_box = isinstance(parameters, spaces.Box)
        self._box_names, self._boxes = self._read_boxes(parameters)
        if not self._has_one_box and len(self._boxes) != num_discrete:
            raise self._refusal(f"{num_discrete} discrete actions, but {len(self._boxes)} Boxes")
        if parameter_dims is not None:
            self._check_split(parameter_dims, num_discrete)
        elif self._has_one_box:
            self._boxes *= num_discrete
        sizes = [int(np.prod(box.shape)) for box in self._boxes]
        self._slices = [slice(end - size, end) for size, end in zip(sizes, np.cumsum(sizes), strict=True)]
        self.parameter_dims = tuple(sizes if parameter_dims is None else parameter_dims)
        if sum(self.parameter_dims) == 0:
            raise self._refusal("no discrete action has a parameter")
        self._low = np.concatenate([box.low.ravel().astype(np.float64) for box in self._boxes])
        self._high = np.concatenate([box.high.ravel().astype(np.float64) for box in self._boxes])
        is_precise = np.concatenate([np.full(box.shape, box.dtype.itemsize > 4).ravel() for box in self._boxes])
        with np.errstate(over="ignore"):
            dtypes = {box.dtype for box in self._boxes}
            self._bounds_by_dtype = {dtype: (self._low.astype(dtype), self._high.astype(dtype)) for dtype in dtypes}
        self._is_unit = is_precise & ~_is_resolved(self._low, self._high)
        self._has_units = bool(self._is_unit.any())
        self._first = int(self._discrete.start)
        self.low = np.where(self._is_unit, -1.0, self._low).astype(np.float32)
        self.high = np.where(self._is_unit, 1.0, self._high).astype(np.float32)

    def to_native(self, discrete: np.ndarray, parameters: np.ndarray) -> list[Any]:
        """Return actions in the space's own format.

        Args:
            discrete: the discrete actions, 0 to K - 1, int64 `[M]`.
            parameters: of all discrete actions, `[M, sum(parameter_dims)]`. Values outside their bounds are clipped;
                NaN becomes the lower bound.
        """
        if self._has_units:
            share = 0.5 * (np.clip(parameters.astype(np.float64), -1.0, 1.0) + 1.0)
            parameters = np.where(self._is_unit, self._low + share * (self._high - self._low), parameters)
        natives = list((self._first + discrete if self._first else discrete).astype(self._discrete.dtype, copy=False))
        # Clipped in the box's own precision: its bounds may differ from the float32 ones by rounding. fmax skips NaN.
        clipped = {
            dtype: np.fmin(np.fmax(self._cast(parameters, dtype), low), high)
            for dtype, (low, high) in self._bounds_by_dtype.items()
        }
        owned = zip(self._boxes, self._slices, strict=True)
        parts = [_by_row(clipped[box.dtype][:, own], box.shape) for box, own in owned]
        if self._has_one_box:
            # A split box is the only one.
            values: list[Any] = [parts[index % len(parts)][row] for row, index in enumerate(discrete.tolist())]
        else:
            values = list(zip(*parts, strict=True))
            if self._box_names is not None:
                values = [dict(zip(self._box_names, boxes, strict=True)) for boxes in values]
        if self._is_one_of:
            chosen = zip(values, discrete.tolist(), strict=True)
            return list(zip(natives, [boxes[index] for boxes, index in chosen], strict=True))
        if self._part_names is not None and self._is_flat:
            (name, _) = self._part_names
            return [{name: native, **boxes} for native, boxes in zip(natives, values, strict=True)]
        if self._part_names is not None:
            first, second = self._part_names
            return [{first: native, second: boxes} for native, boxes in zip(natives, values, strict=True)]
        if self._is_flat:
            return [(native, *boxes) for native, boxes in zip(natives, values, strict=True)]
        return list(zip(natives, values, strict=True))

    def _cast(self, parameters: np.ndarray, dtype: np.dtype) -> np.ndarray:
        if dtype.itemsize >= 4:
            return parameters.astype(dtype, copy=False)
        with np.errstate(over="ignore"):  # parameters of other boxes
            return parameters.astype(dtype)

    def _read_parts(self) -> tuple[spaces.Discrete, spaces.Space]:
        """Return the space of the discrete actions and that of the parameters, and note how the two are combined."""
        space = self._space
        self._part_names: tuple[str, str] | None = None
        self._is_flat = False
        self._is_one_of = isinstance(space, spaces.OneOf)
        if isinstance(space, spaces.OneOf):
            return spaces.Discrete(len(space.spaces)), spaces.Tuple(space.spaces)
        if isinstance(space, spaces.Dict) and len(space.spaces) == 2:
            # Stable: puts the Discrete first, and keeps the order if both or neither are one.
            names = sorted(space.spaces, key=lambda name: not isinstance(space.spaces[name], spaces.Discrete))
            self._part_names = (names[0], names[1])
            parts = [space.spaces[name] for name in names]
        elif isinstance(space, spaces.Dict) and _is_choice_with_boxes(space):
            ((name, choice),) = [(name, part) for name, part in space.items() if isinstance(part, spaces.Discrete)]
            self._part_names, self._is_flat = (name, ""), True
            return choice, spaces.Dict([each for each in space.items() if each[0] != name])
        elif isinstance(space, spaces.Tuple) and len(space.spaces) >= 2:
            parts = list(space.spaces)
            self._is_flat = len(parts) > 2
        else:
            raise self._refusal("not of these forms")
        if not isinstance(parts[0], spaces.Discrete):
            raise self._refusal("no Discrete for the discrete actions")
        return parts[0], spaces.Tuple(parts[1:]) if self._is_flat else parts[1]

    def _read_boxes(self, parameters: spaces.Space) -> tuple[list[str] | None, list[spaces.Box]]:
        """Return the parameters' boxes in the order of the discrete actions, and their names if they have some."""
        names = None
        if isinstance(parameters, spaces.Dict):
            names = _in_order(list(parameters.spaces))
            parts = [parameters.spaces[name] for name in names]
        elif isinstance(parameters, spaces.Tuple):
            parts = list(parameters.spaces)
        else:
            parts = [parameters]
        return names, [self._checked_box(part) for part in parts]

    def _checked_box(self, box: spaces.Space) -> spaces.Box:
        if not isinstance(box, spaces.Box) or box.dtype.kind != "f":
            raise self._refusal("parameters must be Boxes of floats")
        with np.errstate(over="ignore", invalid="ignore"):
            if not np.isfinite(box.high.astype(np.float32) - box.low.astype(np.float32)).all():
                raise self._refusal("parameters must have finite bounds, at most 3.4e38 apart")
        if not (box.low < box.high).all():
            raise self._refusal("a parameter's lower bound must be less than its upper bound")
        return box

    def _check_split(self, parameter_dims: Sequence[int], num_discrete: int) -> None:
        given = f"parameter_dims={list(parameter_dims)}"
        if not self._has_one_box:
            raise self._refusal(f"{given} is for one Box for all discrete actions, but each has a Box of its own")
        size = int(np.prod(self._boxes[0].shape))
        if len(parameter_dims) != num_discrete or min(parameter_dims) < 0 or sum(parameter_dims) != size:
            allowed = f"{num_discrete} numbers of at least 0 that add up to {size}"
            raise SettingError(f"{given}, but must be {allowed}, with the action space {written(self._space)}")

    def _refusal(self, reason: str) -> ValueError:
        return ValueError(f"action space {written(self._space)}: {reason}; {_ACCEPTED}")


class OptionSpace:
    """The entry of an action space that is the option, taken out of it and put back in.

    Args:
        space: of the environment's actions.
        option_key: the option's name in a `Dict` or its number in a `Tuple`; None: the entry `option` of a `Dict`.

    Attributes:
        rest: the space without the option.
        num_options: how many options there are; 0: the space has none.

    Raises:
        ValueError: the space has no such entry, or it is no `Discrete`.
    """

    def __init__(self, space: spaces.Space, option_key: int | str | None = None) -> None:
        entries: dict[int | str, spaces.Space] = {}
        if isinstance(space, spaces.Dict):
            entries.update(space.spaces)
        elif isinstance(space, spaces.Tuple):
            entries.update(enumerate(space.spaces))
        self.rest = space
        self.num_options = 0
        self._is_dict = isinstance(space, spaces.Dict)
        if option_key is None:
            others = [entry for name, entry in entries.items() if name != "option"]
            # If boxes alone are left, or one entry that is no action by itself, `option` is the name of the action.
            is_action = all(isinstance(other, spaces.Box) for other in others)
            is_action |= len(others) == 1 and not _is_action(others[0])
            if not self._is_dict or len(others) == len(entries) or is_action:
                return
            option_key = "option"
        option = entries.pop(option_key, None)
        if not isinstance(option, spaces.Discrete) or not entries:
            given = written(space)
            raise SettingError(
                f"option_key={option_key}: must name a Discrete beside the action, in the action space {given}"
            )
        self._key = option_key
        self._option = option
        self._names = list(entries)
        self.num_options = int(option.n)
        if len(entries) == 1:
            (self.rest,) = entries.values()
        else:
            self.rest = (
                spaces.Dict({str(name): entry for name, entry in entries.items()})
                if self._is_dict
                else spaces.Tuple(list(entries.values()))
            )

    def with_option(self, action: Any, option: int) -> Any:
        """Return an action of the space: one of `rest` with an option, 0 to `num_options` - 1."""
        native = self._option.dtype.type(self._option.start + option)
        if self._is_dict:
            parts = {self._names[0]: action} if len(self._names) == 1 else dict(action)
            return {**parts, self._key: native}
        values = [action] if len(self._names) == 1 else list(action)
        values.insert(int(self._key), native)
        return tuple(values)


def _is_choice_with_boxes(space: spaces.Dict) -> bool:
    """Return whether a space has one `Discrete` and at least two boxes beside it, and nothing else."""
    parts = list(space.spaces.values())
    num_boxes = sum(isinstance(part, spaces.Box) for part in parts)
    return num_boxes >= 2 and num_boxes == len(parts) - 1 and any(isinstance(part, spaces.Discrete) for part in parts)


def _is_action(space: spaces.Space) -> bool:
    """Return whether a space holds a discrete action of its own."""
    if isinstance(space, spaces.Tuple):
        return any(isinstance(part, spaces.Discrete) for part in space.spaces)
    if isinstance(space, spaces.Dict):
        return any(isinstance(part, spaces.Discrete) for part in space.spaces.values())
    return isinstance(space, spaces.OneOf)


def _in_order(names: list[str]) -> list[str]:
    """Return the names in the order of the numbers at their ends if these all differ, else in the order given."""
    endings = [re.search(r"\d+$", str(name)) for name in names]
    numbers = [int(ending.group()) for ending in endings if ending is not None]
    if len(set(numbers)) < len(names):
        return names
    return [name for _, name in sorted(zip(numbers, names, strict=True))]


def _by_row(values: np.ndarray, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Return the rows of values `[M, size]` as arrays of this shape."""
    if len(shape) == 1:  # as a rule
        return list(values)
    rows = values.reshape(len(values), *shape)
    return list(rows) if shape else [rows[row, ...] for row in range(len(rows))]


def _is_resolved(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return whether neighbouring numbers of float32 within the bounds lie at most a millionth of their width apart."""
    largest = np.maximum(np.abs(low), np.abs(high)).astype(np.float32)
    return np.spacing(largest).astype(np.float64) <= _RESOLUTION * (high - low)


def written(space: spaces.Space) -> str:
    """Return a space as one line of text, for an error."""
    return textwrap.shorten(repr(space), 300, placeholder=" ...")
