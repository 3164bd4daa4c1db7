"""Pictures of an episode of Pinball: the walls, the hole, and the ball with the way it made."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hpamdp.env.canvas import BACKGROUND, GOOD, GOOD_EDGE, PAPER, Canvas, Point
from hpamdp.env.pinball import rules
from hpamdp.env.pinball.maps import PinballMap
from hpamdp.env.pinball.rules import PinballState

_TABLE, _WALL, _PATH, _BALL = "#fffdf8", "#8f8a7c", "#86aecb", "#1d3f58"
_MARGIN = 36.0  # units of paper around the table
_SCALE = PAPER - 2.0 * _MARGIN


def draw(track: Sequence[PinballState], table: PinballMap, size: int = 480) -> np.ndarray:
    """Return a picture of an episode so far, uint8 `[size, size, 3]`.

    Args:
        track: its states, one before the first action and one after each, columns `[1]`.
        table: the map.
        size: px from edge to edge.
    """
    canvas = Canvas.for_shapes(size)
    canvas.polygon([_on_paper(corner) for corner in ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))], _TABLE)
    x, y, radius = table.target
    canvas.disc(_on_paper((x, y)), radius * _SCALE, GOOD, GOOD_EDGE, 2.0)
    for polygon in table.polygons:
        canvas.polygon([_on_paper(corner) for corner in polygon], _WALL)
    path = [_on_paper((float(state.x), float(state.y))) for state in track]
    canvas.way(path, _PATH)
    canvas.disc(path[-1], table.ball * _SCALE, _BALL, BACKGROUND, 1.5)
    finished = canvas.smoothed()
    finished.caption(int(track[-1].steps), int(track[-1].outcome), rules.OUTCOMES, top=18.0, bottom=18.0)
    return np.array(finished.image)


def _on_paper(point: Point) -> Point:
    """Map a point of the table, y upwards, to units of paper."""
    return _MARGIN + point[0] * _SCALE, PAPER - _MARGIN - point[1] * _SCALE
