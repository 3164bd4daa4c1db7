"""Pictures of a point's path to a target in the square [-1, 1]^2. The view widens if the point leaves the square."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hpamdp.env.canvas import BACKGROUND, BAD, BAD_EDGE, FAINT, GOOD, GOOD_EDGE, INK, PAPER, Canvas, Point

_FIELD, _RIM = "#ffffff", "#c9c5ba"
_PATH, _BODY = "#2f6690", "#1d3f58"
_TARGET, _TARGET_EDGE = "#f4dfb0", "#c8963e"
_MARGIN = 44.0  # units of paper around the square
_SCALE = PAPER / 2.0 - _MARGIN  # units of paper per unit of length, unless the view widens
_VISIBLE = 1.15  # the margin shows coordinates up to this; beyond it, the view widens


@dataclass(frozen=True)
class Scene:
    """The content of a picture, with y pointing up.

    Attributes:
        path: the agent's positions so far, at least one.
        target, radius: the target's centre, and the distance that counts as a hit.
        outcome: name of the outcome, shown once the episode is over.
        is_over, is_success: whether the episode has ended, and whether it succeeded.
        steps: number of actions so far.
        note: text shown beside the number of steps.
        heading: heading of the agent, rad. None if the agent has no front.
        has_walls: whether the agent must stay within the square.
    """

    path: Sequence[Point]
    target: Point
    radius: float
    outcome: str
    is_over: bool
    is_success: bool
    steps: int
    note: str = ""
    heading: float | None = None
    has_walls: bool = False


def draw(scene: Scene, size: int = 480) -> np.ndarray:
    """Return a picture of the scene, uint8 `[size, size, 3]`."""
    canvas = Canvas.for_shapes(size)
    farthest = max(abs(coordinate) for point in (*scene.path, scene.target) for coordinate in point)
    scale = _SCALE / max(1.0, farthest / _VISIBLE)  # units of paper per unit of length

    def on_paper(point: Point) -> Point:
        return PAPER / 2.0 + point[0] * scale, PAPER / 2.0 - point[1] * scale

    corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
    canvas.polygon([on_paper(corner) for corner in corners], _FIELD, _RIM, 3.0 if scene.has_walls else 1.0)
    fill, edge = _colours(scene)
    canvas.disc(on_paper(scene.target), scene.radius * scale, fill, edge, 1.6)
    canvas.disc(on_paper(scene.target), 2.5, edge)
    path = [on_paper(point) for point in scene.path]
    canvas.way(path, _PATH)
    # On a long path, dots for single steps would merge.
    for point in path[1:-1] if len(path) < 60 else ():
        canvas.disc(point, 2.0, _PATH)
    canvas.disc(path[0], 5.0, BACKGROUND, INK, 2.0)
    _draw_agent(canvas, path[-1], scene.heading)
    finished = canvas.smoothed()
    _write(finished, scene)
    return np.array(finished.image)


def _colours(scene: Scene) -> tuple[str, str]:
    if not scene.is_over:
        return _TARGET, _TARGET_EDGE
    return (GOOD, GOOD_EDGE) if scene.is_success else (BAD, BAD_EDGE)


def _draw_agent(canvas: Canvas, place: Point, heading: float | None) -> None:
    x, y = place
    if heading is None:
        canvas.disc((x, y), 7.0, _BODY, BACKGROUND, 1.6)
        return
    forward_x, forward_y = math.cos(heading), -math.sin(heading)
    shape = [(12.0, 0.0), (-8.0, 7.0), (-4.0, 0.0), (-8.0, -7.0)]
    turned = [(x + f * forward_x - s * forward_y, y + f * forward_y + s * forward_x) for f, s in shape]
    canvas.polygon(turned, _BODY, BACKGROUND, 1.6)


def _write(canvas: Canvas, scene: Scene) -> None:
    canvas.write((18.0, 22.0), f"{scene.steps} {'step' if scene.steps == 1 else 'steps'}", FAINT)
    canvas.write((PAPER - 18.0, 22.0), scene.note, FAINT, anchor="rm")
    if scene.is_over:
        canvas.write((PAPER - 18.0, PAPER - 20.0), scene.outcome, _colours(scene)[1], 16.0, anchor="rm")
