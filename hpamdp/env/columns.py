"""States as named tuples of columns, with a row an environment."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor

State = TypeVar("State", bound=tuple[Tensor, ...])


def where(mask: Tensor, new: State, old: State) -> State:
    """Take `new` in the rows of `mask` `[N]` and `old` elsewhere."""
    return type(old)(*(o if n is o else torch.where(mask, n, o) for n, o in zip(new, old, strict=True)))
