"""Pictures of the way through the four rooms."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import torch

from hpamdp.env.canvas import BACKGROUND, GOOD, GOOD_EDGE, INK, PAPER, Canvas, Point
from hpamdp.env.rooms import rules

_WALL, _DOORWAY, _ICE, _SAND = "#8f8a7c", "#fffdf8", "#d6e7ec", "#f4e6c4"
_PATH, _BODY = "#2f6690", "#1d3f58"
_MARGIN = 44.0  # units of paper around the rooms
_CELL = (PAPER - 2.0 * _MARGIN) / rules.SIZE


def draw(path: Sequence[tuple[int, int]], outcome: int, size: int = 480) -> np.ndarray:
    """Return a picture of ice, sand and walls, and of the way so far.

    Args:
        path: the cells in which the episode's moves began, and where the agent is now.
        outcome: number in `rules.OUTCOMES`.
        size: px from edge to edge.

    Returns:
        uint8 `[size, size, 3]`.
    """
    canvas = Canvas.for_shapes(size)
    for x, y in itertools.product(range(rules.SIZE), repeat=2):
        canvas.polygon(_square((x, y)), _floor(x, y))
    canvas.polygon(_square((rules.GOAL, rules.GOAL)), GOOD, GOOD_EDGE, 2.0)
    canvas.way([_middle(cell) for cell in path], _PATH, 2.5)
    for cell in path[1:-1]:
        canvas.disc(_middle(cell), 3.5, _PATH)
    canvas.disc(_middle(path[0]), 6.0, BACKGROUND, INK, 2.0)
    canvas.disc(_middle(path[-1]), 9.0, _BODY, BACKGROUND, 1.6)
    finished = canvas.smoothed()
    finished.caption(len(path) - 1, outcome, rules.OUTCOMES)
    return np.array(finished.image)


def _floor(x: int, y: int) -> str:
    column, row = torch.tensor(x), torch.tensor(y)
    if not rules.is_free(column, row):
        return _WALL
    if rules.suits(torch.tensor(rules.SKATES), column, row):
        return _ICE
    return _SAND if rules.suits(torch.tensor(rules.BOOTS), column, row) else _DOORWAY


def _middle(cell: tuple[int, int]) -> Point:
    return _MARGIN + (cell[0] + 0.5) * _CELL, _MARGIN + (cell[1] + 0.5) * _CELL


def _square(cell: tuple[int, int]) -> list[Point]:
    x, y = _middle(cell)
    half = _CELL / 2.0 - 0.7
    return [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]
