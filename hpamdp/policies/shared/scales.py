"""The scales by which learned models divide states, changes and rewards."""

from __future__ import annotations

from torch import Tensor

_SMALLEST = 1e-2  # keeps entries that never change from dividing by 0


def scale_of(rows: Tensor) -> Tensor:
    """Return the standard deviation of each entry of rows `[B, ...]`, at least 0.01."""
    # A single row has no sample deviation.
    return rows.std(0, correction=min(1, len(rows) - 1)).clamp(min=_SMALLEST)
