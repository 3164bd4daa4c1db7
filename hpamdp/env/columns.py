"""States as named tuples of columns, with a row an environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

import torch
from torch import Tensor

State = TypeVar("State", bound=tuple[Tensor, ...])


def where(mask: Tensor, new: State, old: State) -> State:
    """Take `new` in the rows of `mask` `[N]` and `old` elsewhere."""
    return type(old)(*(o if n is o else torch.where(mask, n, o) for n, o in zip(new, old, strict=True)))


def taken_back(saved: Mapping[str, Tensor], now: State, owner: str) -> State:
    """Return a state of saved columns, in the types and on the devices of the one that there is.

    Raises:
        ValueError: they are not the columns of such a state of as many environments; it begins with the `owner`.
    """
    if set(saved) != set(now._fields):
        raise ValueError(f"{owner}: the state has {', '.join(now._fields)}, not {', '.join(saved)}")
    for name, column in now._asdict().items():
        if saved[name].shape != column.shape:
            raise ValueError(
                f"{owner}: the state's {name} is {list(saved[name].shape)}, but must be {list(column.shape)}"
            )
    return type(now)(*(saved[name].to(column) for name, column in now._asdict().items()))
