"""Pictures of a point's path to a target in the square [-1, 1]^2. The view widens if the point leaves the square."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hpamdp.env.canvas import BACKGROUND, BAD, BAD_EDGE, GOOD, GOOD_EDGE, INK, PAPER, Canvas, Point

_FIELD, _RIM = "#ffffff", "#c9c5ba"
_PATH, _BODY = "#2f6690", "#1d3f58"
_TARGET, _TARGET_EDGE = "#f4dfb0", "#c8963e"
_MARGIN = 44.0  # units of paper around the square
_SCALE = PAPER / 2.0 - _MARGIN  # units of paper per unit of length, unless the view widens
_VISIBLE = 1.15  # the margin shows coordinates up to this; beyond it, the view widens


def draw(
    path: Sequence[Point],
    target: Point,
    radius: float,
    *,
    outcome: int,
    heading: float | None,
    has_walls: bool,
) -> Canvas:
    """Return a picture without labels, of 480 px, with y pointing up.

    Args:
        path: the agent's positions so far, at least one.
        target, radius: the target's centre, and the distance that counts as a hit.
        outcome: number of the outcome: 0 if the episode goes on, 1 if it succeeded.
        heading: heading of the agent, rad. None if the agent has no front.
        has_walls: whether the agent must stay within the square.
    """
    canvas = Canvas.for_shapes(480)
    farthest = max(abs(coordinate) for point in (*path, target) for coordinate in point)
    scale = _SCALE / max(1.0, farthest / _VISIBLE)  # units of paper per unit of length

    def on_paper(point: Point) -> Point:
        return PAPER / 2.0 + point[0] * scale, PAPER / 2.0 - point[1] * scale

    corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
    canvas.polygon([on_paper(corner) for corner in corners], _FIELD, _RIM, 3.0 if has_walls else 1.0)
    fill, edge = [(_TARGET, _TARGET_EDGE), (GOOD, GOOD_EDGE), (BAD, BAD_EDGE)][min(outcome, 2)]
    canvas.disc(on_paper(target), radius * scale, fill, edge, 1.6)
    canvas.disc(on_paper(target), 2.5, edge)
    way = [on_paper(point) for point in path]
    canvas.way(way, _PATH)
    # On a long path, dots for single steps would merge.
    for point in way[1:-1] if len(way) < 60 else ():
        canvas.disc(point, 2.0, _PATH)
    canvas.disc(way[0], 5.0, BACKGROUND, INK, 2.0)
    _draw_agent(canvas, way[-1], heading)
    return canvas.smoothed()


def _draw_agent(canvas: Canvas, place: Point, heading: float | None) -> None:
    x, y = place
    if heading is None:
        canvas.disc((x, y), 7.0, _BODY, BACKGROUND, 1.6)
        return
    forward_x, forward_y = math.cos(heading), -math.sin(heading)
    shape = [(12.0, 0.0), (-8.0, 7.0), (-4.0, 0.0), (-8.0, -7.0)]
    turned = [(x + f * forward_x - s * forward_y, y + f * forward_y + s * forward_x) for f, s in shape]
    canvas.polygon(turned, _BODY, BACKGROUND, 1.6)
