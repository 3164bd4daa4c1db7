"""Pictures of an episode of Goal: the pitch, the goal, the player, the keeper and the way of the ball."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from torch import Tensor

from hpamdp.env.canvas import BACKGROUND, INK, PAPER, Canvas, Point
from hpamdp.env.goal import rules
from hpamdp.env.goal.rules import GoalState

_GRASS, _LINE, _NET = "#cfe3cc", "#ffffff", "#e3e1da"
_PLAYER, _KEEPER = "#2f6690", "#c8963e"
_BALL, _PATH = "#2d3e48", "#86a58a"
_SCALE = 14.0  # units of paper for each unit of length
_LEFT = (PAPER - (rules.LENGTH + rules.GOAL_DEPTH) * _SCALE) / 2.0


def draw(track: Sequence[GoalState], size: int = 480) -> np.ndarray:
    """Return a picture of an episode so far, uint8 `[size, size, 3]`.

    Args:
        track: its states, one before the first action and one after each, columns `[1]`.
        size: px from edge to edge.
    """
    last = track[-1]
    canvas = Canvas.for_shapes(size)
    _rectangle(canvas, (0.0, -rules.HALF_WIDTH), (rules.LENGTH, rules.HALF_WIDTH), _GRASS)
    goal = (rules.LENGTH + rules.GOAL_DEPTH, rules.GOAL_HALF_WIDTH)
    _rectangle(canvas, (rules.LENGTH, -rules.GOAL_HALF_WIDTH), goal, _NET)
    for side in (-1.0, 1.0):
        post = (rules.LENGTH, side * rules.GOAL_HALF_WIDTH)
        canvas.line(_on_paper((rules.LENGTH, side * rules.HALF_WIDTH)), _on_paper(post), _LINE, 2.0)
        canvas.disc(_on_paper(post), 4.0, INK)
    path = [_on_paper(_place(state.ball_x, state.ball_y)) for state in track]
    canvas.way(path, _PATH)
    for place in path[:-1]:
        canvas.disc(place, 2.5, _PATH)
    _draw_body(canvas, _place(last.keeper_x, last.keeper_y), float(last.keeper_angle), rules.KEEPER_SIZE, _KEEPER)
    _draw_body(canvas, _place(last.player_x, last.player_y), float(last.player_angle), rules.PLAYER_SIZE, _PLAYER)
    canvas.disc(path[-1], rules.BALL_SIZE * _SCALE, _BALL, BACKGROUND, 1.5)
    finished = canvas.smoothed()
    finished.caption(int(last.steps), int(last.outcome), rules.OUTCOMES, top=16.0, bottom=16.0)
    return np.array(finished.image)


def _place(x: Tensor, y: Tensor) -> Point:
    return float(x), float(y)


def _on_paper(point: Point) -> Point:
    return _LEFT + point[0] * _SCALE, PAPER / 2.0 - point[1] * _SCALE


def _rectangle(canvas: Canvas, low: Point, high: Point, colour: str) -> None:
    corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    canvas.polygon([_on_paper(corner) for corner in corners], colour)


def _draw_body(canvas: Canvas, place: Point, angle: float, size: float, colour: str) -> None:
    """Draw a disc with a stroke to where it looks."""
    canvas.disc(_on_paper(place), size * _SCALE, colour, BACKGROUND, 1.5)
    front = (place[0] + size * math.cos(angle), place[1] + size * math.sin(angle))
    canvas.line(_on_paper(place), _on_paper(front), BACKGROUND, 2.5)
