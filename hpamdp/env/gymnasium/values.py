"""Numbers and flags that a third-party environment returns, checked before any conversion can change them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from hpamdp.env.errors import ProblemError
from hpamdp.messages import one_line

_LONGEST = 200
_FLOATS = (float, np.float64, np.float32)
_FLAGS = (bool, np.bool_)


class MisfitError(ProblemError):
    """A value has another structure than it must have.

    Args:
        given: the value.
        must_be: what it must be.
    """

    def __init__(self, given: Any, must_be: str) -> None:
        super().__init__(f"gave {shown(given)}, which must be {must_be}")
        self._given, self._must_be = given, must_be

    def named(self, name: str, whole: Any) -> ProblemError:
        """Return the error about an entry of this name, of which the value is the whole or a part."""
        where = f"as {name}" if self._given is whole else f"in {name}"
        return ProblemError(f"gave {shown(self._given)} {where}, which must be {self._must_be}")


def children(space: spaces.Space) -> dict[int | str, spaces.Space]:
    """Return the entries of a Tuple or Dict; an empty dictionary for any other space."""
    entries: dict[int | str, spaces.Space] = {}
    if isinstance(space, spaces.Dict):
        entries.update(space.spaces.items())
    elif isinstance(space, spaces.Tuple):
        entries.update(enumerate(space.spaces))
    return entries


def as_numbers(value: Any) -> np.ndarray | None:
    """Return a value as an array of real numbers in its own dtype; None if it is anything else.

    Text, None, complex numbers, dates, arrays of objects, ragged lists, integers beyond 64 bits and arrays with masked
    entries give None.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        return None
    return array if array.dtype.kind in "biuf" and not np.ma.is_masked(value) else None


def parts_of(given: Any, num: int, names: Sequence[str] | None = None) -> list[Any]:
    """Return what is given in place of the parts of a `Tuple` or, with names, of a `Dict`; None for a missing part.

    Raises:
        MisfitError: `given` is no tuple of `num` parts, or no dict with some of the names.
    """
    if given is None:
        return [None] * num
    if names is not None:
        if not isinstance(given, Mapping) or not given.keys() <= {*names}:
            raise MisfitError(given, f"a dict with names of {list(names)}")
        return [given.get(name) for name in names]
    if not isinstance(given, tuple | list) or len(given) != num:
        raise MisfitError(given, f"a tuple of {num} parts")
    return list(given)


def number(name: str, value: Any) -> float:
    """Return what a step returned as a float; an array of one number counts as the number.

    Raises:
        ProblemError: the value is no number.
    """
    if type(value) in _FLOATS:  # as a rule, and 20 times as fast
        return float(value)
    numbers = as_numbers(value)
    if numbers is None or numbers.size != 1:
        raise ProblemError(f"step returned {shown(value)} as {name}, which must be a number")
    return float(numbers.item())


def flag(name: str, value: Any) -> bool:
    """Return what a step returned as a bool: True, False, 1 or 0, of Python or NumPy, or an array of one of them.

    Raises:
        ProblemError: the value is something else.
    """
    if type(value) in _FLAGS:
        return bool(value)
    numbers = as_numbers(value)
    if numbers is None or numbers.size != 1 or numbers.item() not in (0, 1):
        raise ProblemError(f"step returned {shown(value)} as {name}, which must be True or False")
    return bool(numbers.item())


def shown(value: object) -> str:
    """Return a value of any kind as one short line of text."""
    try:
        text = one_line(repr(value))
    except Exception:  # `repr` is the environment's own code, and refuses integers of over 4,300 digits
        return f"a value of type {type(value).__name__}"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."
