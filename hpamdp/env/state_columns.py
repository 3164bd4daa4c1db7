"""States as named tuples of columns. A column is a tensor with one row per environment."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor


class Columns(Protocol):
    """A `NamedTuple` whose fields are tensors."""

    def __init__(self, *columns: Tensor) -> None: ...

    def __iter__(self) -> Iterator[Tensor]: ...

    @property
    def _fields(self) -> tuple[str, ...]: ...

    def _asdict(self) -> dict[str, Tensor]: ...


State = TypeVar("State", bound=Columns)


def where(mask: Tensor, new: State, old: State) -> State:
    """Return `new` in the rows of `mask` `[N]` and `old` in the others."""
    # Skip columns that both states share.
    return type(old)(*(o if n is o else torch.where(mask, n, o) for n, o in zip(new, old, strict=True)))


def replaced(state: State, **columns: Tensor) -> State:
    """Return the state with some columns replaced by name."""
    return type(state)(*{**state._asdict(), **columns}.values())


def from_arrays(kind: type[State], arrays: Iterable[np.ndarray]) -> State:
    """Return a state whose columns share memory with the arrays, `[N]` each."""
    return kind(*(torch.from_numpy(array) for array in arrays))


def cloned(state: State) -> State:
    """Return a copy of the state."""
    return type(state)(*(column.clone() for column in state))


def overwrite(state: State, new: State) -> None:
    """Copy the values of another state into the columns of this one."""
    for column, values in zip(state, new, strict=True):
        column.copy_(values)


def check_range(columns: Mapping[str, Tensor], limits: Mapping[str, tuple[int, int]]) -> None:
    """Check that every column lies within its limits (lowest value, highest value + 1).

    Raises:
        ValueError: a column lies outside. The message names the first such column.
    """
    for name, (low, high) in limits.items():
        column = columns[name]
        if column.numel() and not low <= int(column.min()) <= int(column.max()) < high:
            raise ValueError(f"{name} has {int(column.min())} to {int(column.max())}, not {low} to {high - 1}")


def restored(saved: Mapping[str, Tensor], current: State, owner: str) -> State:
    """Return the state saved by `_asdict`, with the dtypes and devices of the current state.

    Args:
        saved: columns by name.
        current: a state of the same environments.
        owner: name of the environment's class, for the error.

    Raises:
        ValueError: a column is missing or unknown, or has another shape.
    """
    if set(saved) != set(current._fields):
        raise ValueError(f"{owner}: the state has {', '.join(current._fields)}, not {', '.join(saved)}")
    columns = []
    for name, column in current._asdict().items():
        if saved[name].shape != column.shape:
            raise ValueError(
                f"{owner}: the state's {name} is {list(saved[name].shape)}, but must be {list(column.shape)}"
            )
        columns.append(saved[name].to(column))
    return type(current)(*columns)
