"""Pictures of the office: its walls, the three places, and the path that the agent took."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hpamdp.env.canvas import BACKGROUND, FAINT, GOOD, GOOD_EDGE, INK, Canvas, Point
from hpamdp.env.office import rules
from hpamdp.env.office.options import GOALS
from hpamdp.env.office.rules import OfficeState

_FLOOR, _WALL = "#fffdf8", "#8f8a7c"
_COFFEE, _MAIL = "#c9a583", "#e8d9a0"
_PATH, _BODY = "#2f6690", "#1d3f58"
_LEFT, _TOP, _SIZE = 44.0, 46.0, 392.0  # of the office, units of paper


def draw(track: Sequence[OfficeState], size: int = 480) -> np.ndarray:
    """Return a picture of an episode, uint8 `[size, size, 3]`.

    Args:
        track: the states of one environment from the start on, columns `[1]`.
        size: px from edge to edge.
    """
    last = track[-1]
    has = bool(last.coffee), bool(last.mail)
    canvas = Canvas.for_shapes(size)
    canvas.polygon(_box(0.0, 1.0, 0.0, 1.0), _FLOOR)
    # What was taken leaves an empty place.
    fills = (BACKGROUND if has[0] else _COFFEE, BACKGROUND if has[1] else _MAIL, GOOD)
    for (x, y), fill in zip(rules.PLACES, fills, strict=True):
        around = _box(x - rules.REACH, x + rules.REACH, y - rules.REACH, y + rules.REACH)
        canvas.polygon(around, fill, GOOD_EDGE if fill == GOOD else FAINT, 1.5)
    for wall in rules.WALLS:
        canvas.polygon(_box(*wall), _WALL)
    places = [_on_paper(float(state.x), float(state.y)) for state in track]
    canvas.way(places, _PATH)
    canvas.disc(places[0], 4.0, BACKGROUND, INK, 1.5)
    canvas.disc(places[-1], 7.0, _BODY, BACKGROUND, 1.6)
    for place, (is_held, colour) in enumerate(zip(has, (_COFFEE, _MAIL), strict=True)):
        if is_held:
            canvas.disc((places[-1][0] + (-3.0, 3.0)[place], places[-1][1]), 2.6, colour)
    finished = canvas.smoothed()
    finished.caption(int(last.steps), int(last.outcome), rules.OUTCOMES)
    for (x, y), name in zip(rules.PLACES, GOALS, strict=True):
        finished.write(_on_paper(x, y), name, INK, 12.0, anchor="mm")
    return np.array(finished.image)


def _on_paper(x: float, y: float) -> Point:
    return _LEFT + x * _SIZE, _TOP + y * _SIZE


def _box(left: float, right: float, top: float, bottom: float) -> list[Point]:
    return [_on_paper(*corner) for corner in ((left, top), (right, top), (right, bottom), (left, bottom))]
