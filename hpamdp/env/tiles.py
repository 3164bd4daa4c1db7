"""Encode a place on a map as tiles: triangular basis functions of each coordinate.

A coordinate in [0, 1] becomes `tiles` numbers in [0, 1]. Each is 1 in the middle of its tile and falls linearly to 0 in
the middle of the next one. So it is not tile coding, whose features are 0 or 1 and overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from hpamdp.env.kernels import HALF, ONE, ZERO, part


@part
def write_tiles(x: Any, y: Any, tiles: Any, observation: Any, first: Any) -> None:
    """Write the tiles of x, then those of y, into a row's observation, from the entry `first` on."""
    for tile in range(tiles):
        middle = np.float32(tile) + HALF
        observation[first + tile] = max(ONE - abs(x * np.float32(tiles) - middle), ZERO)
        observation[first + tiles + tile] = max(ONE - abs(y * np.float32(tiles) - middle), ZERO)


def bounds_with_tiles(num: int, tiles: int) -> tuple[Sequence[float], Sequence[float]]:
    """Return the bounds of an observation with `num` entries in [-1, 1] and the tiles of x and y behind them."""
    return [-1.0] * num + [0.0] * 2 * tiles, [1.0] * (num + 2 * tiles)


def tile_names(tiles: int) -> tuple[str, ...]:
    """Return the names of the tiles, in their order."""
    return tuple(f"{axis}_{number}" for axis in "xy" for number in range(tiles))
