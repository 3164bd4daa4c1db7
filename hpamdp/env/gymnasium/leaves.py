"""The spaces inside an observation space. Values are checked against their space, then flattened."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim

from hpamdp.env.errors import ProblemError
from hpamdp.env.gymnasium.action_parts import max_values
from hpamdp.env.gymnasium.options import OutOfBounds
from hpamdp.env.gymnasium.values import as_numbers, children, shown

# Units in the last place beyond a bound that count as rounding.
_ROUNDING = 4.0
# The dtype of the agent's observations.
_OBSERVED = np.dtype(np.float32)
# Longest one-hot vector.
_MOST_ONE_HOT = 100_000
# Types of a plain value of a Discrete.
_INTEGERS = (int, np.int64, np.int32)
_WHOLE = [np.dtype(name) for name in ("bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32")]


class Leaf:
    """A `Box`, `Discrete`, `MultiDiscrete` or `MultiBinary` inside an observation space.

    A value must have the space's shape; a `Discrete` also takes an array of one number. Integers and booleans must be
    whole numbers within the space. Floats are rounded to the space's dtype. They are compared with
    the bounds in the space's dtype, or in the value's dtype if this is less precise. Differences of a few units in the
    last place count as rounding.

    Args:
        space: the leaf's space.
        path: the entries of `Tuple` and `Dict` spaces that lead to it, from the outermost on.
        lengths: for each entry of the path, the number of entries beside it if it is one of a `Tuple`, else None.
        out_of_bounds: what happens to finite numbers of a `Box` outside its bounds: they are refused, moved to the
            bound, or kept as they are.

    Attributes:
        what: the leaf in words, such as `entry a.b`.
        size: length of its vector.
        lowest, highest: bounds `[size]` of what `quick` leaves unchecked. `flat` checks others.
        clip_low, clip_high: bounds `[size]` that numbers are moved to; infinite if they are kept or refused.
        rounding: dtype that the vector is rounded to; None if it needs no rounding.
    """

    def __init__(
        self,
        space: spaces.Space,
        path: tuple[int | str, ...] = (),
        lengths: tuple[int | None, ...] = (),
        out_of_bounds: OutOfBounds = "refuse",
    ) -> None:
        self.space = space
        self.path = path
        self._lengths = lengths
        self._out_of_bounds = out_of_bounds
        self.what = f"entry {'.'.join(map(str, path))}" if path else "value"
        self.size = flatdim(space)
        self.lowest = np.zeros(self.size)
        self.highest = np.ones(self.size)
        self.clip_low = np.full(self.size, -np.inf)
        self.clip_high = np.full(self.size, np.inf)
        self.rounding: np.dtype | None = None
        self._plain_dtypes = frozenset(_WHOLE)
        self._start: np.ndarray | int = 0  # of numbers that are not in a Box, and how many values each has
        self._sizes: np.ndarray | int = 2
        if isinstance(space, spaces.Box):
            self._read_bounds(space)
        elif isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
            sizes: Any = space.n if isinstance(space, spaces.Discrete) else space.nvec
            self._start, self._sizes = np.ravel(space.start), np.ravel(sizes)

    def quick(self, observations: Sequence[Any]) -> np.ndarray | None:
        """Return the leaf's part of M observations, float64 `[M, size]`; None if one has to be checked by `flat`.

        This is the quick way for parts of a plain kind: arrays of the space's shape whose dtype the space can hold, and
        whole numbers of a `Discrete`, all within their bounds.

        Raises:
            ProblemError: an observation lacks the part.
        """
        values = [self._find(observation) for observation in observations]
        if isinstance(self.space, spaces.Discrete):
            are_plain = all(type(value) in _INTEGERS for value in values)
        else:
            are_plain = self._are_arrays(values, self._plain_dtypes)
        if not are_plain:
            return None
        given = np.array(values).reshape(len(values), -1)
        if not isinstance(self.space, spaces.Box):
            return self._encoded(given)
        vectors = given.astype(np.float64)
        if not ((vectors >= self.lowest) & (vectors <= self.highest)).all():
            return None
        if self._out_of_bounds == "clip":
            vectors = vectors.clip(self.clip_low, self.clip_high)
        return vectors if self.rounding is None else vectors.astype(self.rounding).astype(np.float64)

    def quick_pixels(self, observations: Sequence[Any]) -> np.ndarray | None:
        """Return the leaf's pictures, uint8 `[M, size]`, as `quick` does; only uint8 cannot be outside the space."""
        values = [self._find(observation) for observation in observations]
        return np.array(values).reshape(len(values), -1) if self._are_arrays(values, {np.dtype(np.uint8)}) else None

    def _are_arrays(self, values: Sequence[Any], dtypes: Container[np.dtype]) -> bool:
        shape = self.space.shape
        return all(type(value) is np.ndarray and value.dtype in dtypes and value.shape == shape for value in values)

    def flat(self, observation: Any, cure: str = "") -> np.ndarray:
        """Return the leaf's part of an observation as a vector, float64; discrete values are one-hot.

        Args:
            observation: an observation of the whole space.
            cure: what to add to the message about a discrete value outside its space.

        Raises:
            ProblemError: the part is missing or not in the space.
        """
        value = self._find(observation)
        numbers = as_numbers(value)
        if numbers is None:
            raise self._problem(f"is {shown(value)}, not numbers that NumPy can hold")
        if isinstance(self.space, spaces.Discrete) and numbers.size == 1:
            numbers = numbers.reshape(())
        if numbers.shape != self.space.shape:
            raise self._problem(f"has shape {numbers.shape}, but its space has {self.space.shape}")
        if isinstance(self.space, spaces.Box):
            return self._box(numbers).ravel()
        return self._one_hot(numbers, cure)

    def picture(self, observation: Any) -> np.ndarray:
        """Return the leaf's picture as a vector, as `flat` does.

        Raises:
            ProblemError: the picture is missing, not in the space, or made of floats from 0 to 1.
        """
        numbers = as_numbers(self._find(observation))
        if numbers is not None and numbers.dtype.kind == "f" and 0.0 < numbers.max(initial=0.0) <= 1.0:
            raise self._problem("has pixels from 0 to 1, but its space has 0 to 255; give the picture unscaled")
        return self.flat(observation)

    def _find(self, observation: Any) -> Any:
        value = observation
        for entry, length in zip(self.path, self._lengths, strict=True):
            is_dict = length is None
            if is_dict and type(value) is dict and entry in value:  # as a rule
                value = value[entry]
                continue
            if not isinstance(value, Mapping if is_dict else tuple | list | np.ndarray):
                raise ProblemError(f"gave an observation without its {self.what}")
            if not is_dict and len(value) != length:
                raise ProblemError(f"gave an observation of {len(value)} entries, but its space has {length}")
            if is_dict and entry not in value:
                raise ProblemError(f"gave an observation without its {self.what}")
            entries: Any = value
            value = entries[entry]
        return value

    def _read_bounds(self, box: spaces.Box) -> None:
        self._own = np.dtype(box.dtype)
        self._is_float = self._own.kind == "f"
        self._low = box.low.astype(np.float64)
        self._high = box.high.astype(np.float64)
        # The dtype in which a number must be finite: the agent's, or the space's own if that is less precise.
        self._holder = _coarser(self._own, _OBSERVED) if self._is_float else _OBSERVED
        largest = float(np.finfo(self._holder).max)
        slack = self._slack(self._own) if self._is_float else 0.0
        self._lowest = np.maximum(self._low - slack, -largest)
        self._highest = np.minimum(self._high + slack, largest)
        self.lowest, self.highest = self._lowest.ravel(), self._highest.ravel()
        if self._out_of_bounds != "refuse":
            self.lowest, self.highest = np.full(self.size, -largest), np.full(self.size, largest)
        if self._out_of_bounds == "clip":
            self.clip_low, self.clip_high = self._low.ravel(), self._high.ravel()
        if self._is_float and self._own.itemsize < 8:
            self.rounding = self._own
        # Of the same precision as the space or a higher one: no other rounding is allowed for.
        precise = {self._own, np.dtype(np.float64)} if self._is_float else set()
        self._plain_dtypes = frozenset({*_WHOLE, *precise})

    def _slack(self, dtype: np.dtype) -> np.ndarray:
        """Return how far beyond its bounds a number of this dtype may be by rounding."""
        return _ROUNDING * float(np.finfo(dtype).eps) * np.maximum(_size(self._low), _size(self._high))

    def _box(self, numbers: np.ndarray) -> np.ndarray:
        values = numbers.astype(np.float64)
        is_whole = self._is_float or numbers.dtype.kind != "f" or (values == np.floor(values)).all()
        if not (is_whole and ((values >= self._lowest) & (values <= self._highest)).all()):
            values = self._within_bounds(values, numbers.dtype)
        elif self._out_of_bounds == "clip":
            values = np.clip(values, self._low, self._high)
        return values.astype(self._own).astype(np.float64) if self._is_float else values

    def _within_bounds(self, values: np.ndarray, dtype: np.dtype) -> np.ndarray:
        """Treat numbers of which some may be outside the bounds as `out_of_bounds` says.

        Args:
            values: the numbers.
            dtype: the dtype in which the environment gave them.
        """
        self._refuse_where(~np.isfinite(values), values, "which is not finite")
        if not self._is_float:
            self._refuse_where(values != np.floor(values), values, f"which {self._own} cannot hold")
        if self._out_of_bounds == "clip":
            values = np.clip(values, self._low, self._high)
        elif self._out_of_bounds == "refuse":
            slack: Any = 0.0
            if self._is_float:
                slack = self._slack(_coarser(self._own, dtype) if dtype.kind == "f" else self._own)
            is_outside = (values < self._low - slack) | (values > self._high + slack)
            cure = "env.out_of_bounds=clip moves it there, allow keeps it"
            self._refuse_where(is_outside, values, f"outside its bounds {{bounds}}; {cure}")
        with np.errstate(over="ignore"):
            is_too_large = ~np.isfinite(values.astype(self._holder))
        self._refuse_where(is_too_large, values, f"which {self._holder} cannot hold")
        return values

    def _one_hot(self, numbers: np.ndarray, cure: str) -> np.ndarray:
        is_whole = numbers.dtype.kind != "f" or bool((np.isfinite(numbers) & (numbers == np.floor(numbers))).all())
        encoded = self._encoded(numbers.reshape(1, -1)) if is_whole else None
        if encoded is None:
            raise self._problem(f"is {shown(numbers.tolist())}, outside {self.space}{cure}")
        return encoded[0]

    def _encoded(self, numbers: np.ndarray) -> np.ndarray | None:
        """Return whole numbers `[M, numbers]` one-hot, those of a `MultiBinary` as they are; None if one is outside."""
        whole = numbers.astype(np.int64) - self._start
        if not ((whole >= 0) & (whole < self._sizes)).all():
            return None
        if isinstance(self.space, spaces.MultiBinary):
            return whole.astype(np.float64)
        vectors = np.zeros((len(numbers), self.size))
        np.put_along_axis(vectors, np.cumsum(self._sizes) - self._sizes + whole, 1.0, 1)
        return vectors

    def _refuse_where(self, is_wrong: np.ndarray, values: np.ndarray, reason: str) -> None:
        if not is_wrong.any():
            return
        place = tuple(map(int, np.argwhere(is_wrong)[0]))
        reason = reason.format(bounds=f"{self._low[place]:.10g} to {self._high[place]:.10g}")
        index = f" at index {', '.join(map(str, place))}" if place else ""
        raise self._problem(f"is {values[place]:.10g}{index}, {reason}")

    def _problem(self, fault: str) -> ProblemError:
        return ProblemError(f"gave an observation whose {self.what} {fault}")


def leaves(
    space: spaces.Space,
    out_of_bounds: OutOfBounds = "refuse",
    path: tuple[int | str, ...] = (),
    lengths: tuple[int | None, ...] = (),
) -> Iterator[Leaf]:
    """Yield the leaves of a space, in the order of its flattened vector.

    Entries of more than 100,000 values are boxes of integers.
    """
    entries = children(space)
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete) and max_values(space) > _MOST_ONE_HOT:
        sizes: Any = space.n if isinstance(space, spaces.Discrete) else space.nvec
        space = spaces.Box(space.start, space.start + sizes - 1, space.shape, np.int64)
    if not isinstance(space, spaces.Tuple | spaces.Dict):
        yield Leaf(space, path, lengths, out_of_bounds)
    for entry, child in entries.items():
        length = len(entries) if isinstance(space, spaces.Tuple) else None
        yield from leaves(child, out_of_bounds, (*path, entry), (*lengths, length))


def _coarser(one: np.dtype, other: np.dtype) -> np.dtype:
    """Return the less precise of two dtypes of floats."""
    return max(one, other, key=lambda dtype: float(np.finfo(dtype).eps))


def _size(bounds: np.ndarray) -> np.ndarray:
    """Return the sizes of finite bounds, and 0 for the others."""
    return np.where(np.isfinite(bounds), np.abs(bounds), 0.0)
