"""A place on a map as tiles, from which a network tells places apart more easily than from two numbers.

A coordinate in [0, 1] becomes `tiles` numbers in [0, 1]. Each is 1 in the middle of its tile and falls linearly to 0 in
the middle of the next one.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from hpamdp.env.kernels import HALF, ONE, ZERO, part

NumTiles = Annotated[int, Field(ge=0, le=100)]


def tiles_of(x: Tensor, y: Tensor, tiles: int) -> Tensor:
    """Return the tiles of x, then those of y, `[N, 2 tiles]`, for coordinates `[N]`."""
    middle = torch.arange(tiles, dtype=x.dtype, device=x.device) + 0.5
    return torch.cat([(1.0 - (at.unsqueeze(-1) * tiles - middle).abs()).clamp(min=0.0) for at in (x, y)], -1)


@part
def write_tiles(x: Any, y: Any, tiles: Any, observation: Any, first: Any) -> None:
    """Write the tiles of one row into its observation, from the place `first` on: `tiles_of`."""
    for tile in range(tiles):
        middle = np.float32(tile) + HALF
        observation[first + tile] = max(ONE - abs(x * np.float32(tiles) - middle), ZERO)
        observation[first + tiles + tile] = max(ONE - abs(y * np.float32(tiles) - middle), ZERO)


def tile_names(tiles: int) -> tuple[str, ...]:
    """Return the names of the entries of `tiles_of`."""
    return tuple(f"{axis}_{number}" for axis in "xy" for number in range(tiles))
