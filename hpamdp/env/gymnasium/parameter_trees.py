"""Trees of Gymnasium spaces whose numbers are all parameters: of one discrete action, or of several side by side.

A `Box` has one parameter for each number. A `Discrete`, `MultiDiscrete` or `MultiBinary` has one integer parameter for
each number. A `OneOf` has an integer parameter, the alternative, and then the parameters of all alternatives. A number
with a single value, as in `Discrete(1)`, is no parameter.

An agent's parameters are float32. Usually they are the numbers of the space. There are three exceptions, where float32
cannot hold these numbers:

- A float64 `Box` with large bounds close together, such as times in seconds since 1970: float32 cannot resolve a
  millionth of its width. The agent's parameter then lies in [-1, 1], and is mapped to the `Box` in float64.
- Integers beyond 16,777,216. They are counted from their lower bound.
- More than 16,777,216 integers between the bounds. The agent's parameter is then a real number in [-1, 1], in which
  each integer has a cell of equal width.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from hpamdp.env.gymnasium.values import MisfitError, as_numbers, children, parts_of
from hpamdp.env.gymnasium_form import ParameterMap

# Largest distance between neighbouring float32 numbers that is fine enough, as a fraction of the width of a Box.
_RESOLUTION = 1e-6
_MOST_EXACT = float(1 << 24)  # float32 holds all integers up to this one
_MOST_WHOLE = 1 << 53  # float64 holds all integers up to this one
_WHOLE = np.dtype(np.int64)  # stands for all integer dtypes
_TOO_LARGE = "parameters must have finite bounds, at most 9e15 for whole numbers"
_CROSSED = "a parameter's lower bound must be less than its upper bound"

# Makes M values of a space from parameters `[M, size]` within their bounds, which are given in each dtype of the space.
_Build = Callable[[Mapping[np.dtype, np.ndarray]], list[Any]]
_Fill = Callable[[Any, np.ndarray], None]  # writes the parameters of a value; see `ParameterTree.fill`


class NotAcceptedError(ValueError):
    """Why a space is not accepted, without the space's name."""


@dataclass(frozen=True)
class _Entry:
    """A space without parts, and where its parameters are.

    Attributes:
        space: a `Box`, `Discrete`, `MultiDiscrete` or `MultiBinary`.
        low, high: bounds of its numbers, float64 `[numbers]`.
        is_free: which numbers are parameters, bool `[numbers]`. The others have a single value.
        start: place of the first parameter among those of the tree.
    """

    space: spaces.Space
    low: np.ndarray
    high: np.ndarray
    is_free: np.ndarray
    start: int

    @property
    def own(self) -> slice:
        """Places of the parameters among those of the tree."""
        return slice(self.start, self.start + int(self.is_free.sum()))

    @property
    def is_float(self) -> bool:
        """Whether the numbers are floats."""
        return self.space.dtype is not None and np.dtype(self.space.dtype).kind == "f"


class ParameterTree:
    """The parameters of a tree of spaces, and the conversion of parameters to values of the tree.

    Args:
        space: see the module's docstring.

    Attributes:
        size: number of parameters.
        map: how the agent's parameters become the space's own.

    Raises:
        NotAcceptedError: the tree has a space of another kind, or bounds that are not finite.
    """

    def __init__(self, space: spaces.Space) -> None:
        self.size = 0
        self._entries: list[_Entry] = []
        self._build, self._fill = self._read(space)
        low, high = self._joined("low"), self._joined("high")
        is_float = self._spread(lambda entry: entry.is_float)
        is_precise = self._spread(lambda entry: entry.is_float and np.dtype(entry.space.dtype).itemsize > 4)
        with np.errstate(over="ignore"):
            floats = {np.dtype(entry.space.dtype) for entry in self._entries if entry.is_float}
            self._bounds = {dtype: (low.astype(dtype), high.astype(dtype)) for dtype in floats}
        if len(floats) == 0 or not all(entry.is_float for entry in self._entries):
            self._bounds[_WHOLE] = (low, high)
        is_many = ~is_float & (high - low >= _MOST_EXACT)
        is_unit = (is_precise & ~_is_resolved(low, high)) | is_many
        # Lower bounds of integers that float32 holds only if they are counted from there.
        shift = np.where(~is_float & ~is_many & (np.maximum(np.abs(low), np.abs(high)) > _MOST_EXACT), low, 0.0)
        self.map = ParameterMap(low, high, shift, is_unit, is_many, ~is_float)
        self._is_mapped = not self.map.is_identity

    def natives(self, parameters: np.ndarray, bounds: tuple[np.ndarray, np.ndarray] | None = None) -> list[Any]:
        """Return values of the space.

        Args:
            parameters: the agent's, `[M, size]`. Values outside their bounds are clipped, and NaN becomes the lower
                bound. Integer parameters are rounded to the nearest integer.
            bounds: narrower bounds of the space's own parameters, float64 `[M, size]` each.
        """
        if self._is_mapped:
            parameters = self.map.numbers(parameters)
        # Clipped in the space's own precision: its bounds may differ from the float32 ones by rounding. fmax skips NaN.
        clipped = {}
        for dtype, (low, high) in self._bounds.items():
            if dtype == _WHOLE:
                values: Any = np.rint(parameters.astype(np.float64))
                low, high = (low, high) if bounds is None else bounds
            else:
                values = _cast(parameters, dtype)
                low, high = (low, high) if bounds is None else (_cast(bounds[0], dtype), _cast(bounds[1], dtype))
            clipped[dtype] = np.fmin(np.fmax(values, low), high)
        return self._build(clipped)

    def fill(self, given: Any, numbers: np.ndarray) -> None:
        """Write numbers that are given in the structure of the space into a vector of the space's own parameters.

        Args:
            given: in the structure of a value of the space. Parts may be None or, in a dict, missing; the vector then
                keeps their numbers. The choice of an alternative is ignored.
            numbers: the vector, float64 `[size]`.

        Raises:
            MisfitError: `given` has another structure.
        """
        self._fill(given, numbers)

    def _read(self, space: spaces.Space) -> tuple[_Build, _Fill]:
        """Return how values of the space are built from parameters, and how parameters are read from a value."""
        if isinstance(space, spaces.Tuple | spaces.Dict | spaces.OneOf):
            names = list(space.spaces) if isinstance(space, spaces.Dict) else None
            number = self._read(spaces.Discrete(len(space.spaces)))[0] if isinstance(space, spaces.OneOf) else None
            alternatives = space.spaces if isinstance(space, spaces.OneOf) else children(space).values()
            parts = [self._read(part) for part in alternatives]
            build = _build_parts([part[0] for part in parts], names, number)
            return build, _fill_parts([part[1] for part in parts], names)
        low, high, is_free = bounds_of(space)
        entry = _Entry(space, low, high, is_free, self.size)
        self._entries.append(entry)
        self.size = entry.own.stop
        return _build_entry(entry), _fill_entry(entry)

    def _joined(self, name: str) -> np.ndarray:
        parts = [getattr(entry, name)[entry.is_free] for entry in self._entries]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _spread(self, of_entry: Callable[[_Entry], bool]) -> np.ndarray:
        parts = [np.full(int(entry.is_free.sum()), of_entry(entry)) for entry in self._entries]
        return np.concatenate(parts) if parts else np.zeros(0, bool)


def bounds_of(space: spaces.Space) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the bounds of a space without parts, float64 `[numbers]` each, and which of its numbers can vary, bool.

    Raises:
        NotAcceptedError: the space has parts or is of another kind, or its bounds are not finite.
    """
    if isinstance(space, spaces.Discrete):
        low, high = np.array([space.start], np.int64), np.array([space.start + space.n - 1], np.int64)
    elif isinstance(space, spaces.MultiDiscrete):
        low = np.asarray(space.start, np.int64).ravel()
        high = low + np.asarray(space.nvec, np.int64).ravel() - 1
    elif isinstance(space, spaces.MultiBinary):
        size = int(np.prod(space.shape))
        low, high = np.zeros(size, np.int64), np.ones(size, np.int64)
    elif isinstance(space, spaces.Box) and space.dtype.kind in "f":
        return _float_bounds(space)
    elif isinstance(space, spaces.Box) and space.dtype.kind in "iub":
        low, high = space.low.ravel(), space.high.ravel()
        if not space.is_bounded():
            raise NotAcceptedError(_TOO_LARGE)
        if not (low < high).all():
            raise NotAcceptedError(_CROSSED)
    else:
        raise NotAcceptedError(f"has a {type(space).__name__}")
    if any(abs(int(bound)) > _MOST_WHOLE for bound in (*low, *high)):
        raise NotAcceptedError(_TOO_LARGE)
    return low.astype(np.float64), high.astype(np.float64), low < high


def _float_bounds(box: spaces.Box) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    with np.errstate(over="ignore", invalid="ignore"):
        if not np.isfinite(box.high.astype(np.float32) - box.low.astype(np.float32)).all():
            raise NotAcceptedError("parameters must have finite bounds, at most 3.4e38 apart")
    if not (box.low < box.high).all():
        raise NotAcceptedError(_CROSSED)
    return box.low.ravel().astype(np.float64), box.high.ravel().astype(np.float64), np.ones(box.low.size, bool)


def _build_entry(entry: _Entry) -> _Build:
    space, own = entry.space, entry.own
    key = np.dtype(space.dtype) if entry.is_float else _WHOLE
    shape = space.shape or ()
    if entry.is_float:
        return lambda columns: by_row(columns[key][:, own], shape)
    kind = np.dtype(space.dtype)
    fixed, is_free, is_scalar = entry.low, entry.is_free, isinstance(space, spaces.Discrete)

    def build(columns: Mapping[np.dtype, np.ndarray]) -> list[Any]:
        values = columns[key][:, own]
        if not is_free.all():
            free, values = values, np.tile(fixed, (len(values), 1))
            values[:, is_free] = free
        values = values.astype(kind)
        return list(values[:, 0]) if is_scalar else by_row(values, shape)

    return build


def _build_parts(parts: Sequence[_Build], names: Sequence[str] | None, number: _Build | None) -> _Build:
    def build(columns: Mapping[np.dtype, np.ndarray]) -> list[Any]:
        if not parts:
            rows: list[Any] = [()] * len(next(iter(columns.values())))
        else:
            rows = list(zip(*[part(columns) for part in parts], strict=True))
        if number is not None:  # the alternative of a OneOf
            return [(index, row[int(index)]) for index, row in zip(number(columns), rows, strict=True)]
        return rows if names is None else [dict(zip(names, row, strict=True)) for row in rows]

    return build


def _fill_entry(entry: _Entry) -> _Fill:
    shape = entry.space.shape or ()

    def fill(given: Any, numbers: np.ndarray) -> None:
        if given is None:
            return
        values = as_numbers(given)
        if values is None or values.shape != shape:
            raise MisfitError(given, f"of shape {shape} of {entry.space}")
        numbers[entry.own] = values.astype(np.float64).ravel()[entry.is_free]

    return fill


def _fill_parts(fills: Sequence[_Fill], names: Sequence[str] | None) -> _Fill:
    def fill(given: Any, numbers: np.ndarray) -> None:
        for fill_part, part in zip(fills, parts_of(given, len(fills), names), strict=True):
            fill_part(part, numbers)

    return fill


def by_row(values: np.ndarray, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Return the rows of values `[M, size]` as arrays of this shape."""
    if len(shape) == 1:  # the usual case, without a reshape
        return list(values)
    rows = values.reshape(len(values), *shape)
    return list(rows) if shape else [rows[row, ...] for row in range(len(rows))]


def _cast(parameters: np.ndarray, dtype: np.dtype) -> np.ndarray:
    if dtype.itemsize >= 4:
        return parameters.astype(dtype, copy=False)
    with np.errstate(over="ignore"):  # a column of another box may be too large for this dtype; it is not used
        return parameters.astype(dtype)


def _is_resolved(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return whether neighbouring numbers of float32 within the bounds lie at most a millionth of their width apart."""
    largest = np.maximum(np.abs(low), np.abs(high)).astype(np.float32)
    return np.spacing(largest).astype(np.float64) <= _RESOLUTION * (high - low)
