"""Pictures of the course: its platforms, the agent with the way it made, and both enemies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hpamdp.env.canvas import INK, PAPER, Canvas
from hpamdp.env.platform import rules
from hpamdp.env.platform.rules import PlatformState

_GROUND, _AGENT, _ENEMY, _PATH = "#8a9a7b", "#2f6690", "#b9503a", "#86aecb"
_SCALE = (PAPER - 40.0) / (rules.END + rules.BODY_WIDTH)  # units of paper for each px
_LEFT, _TOP = 20.0, 60.0  # where the course begins, and the height of the platforms' tops
_DEPTH = 10.0  # of the platforms
_HEIGHT = 80.0  # of the picture, units of paper


def draw(track: Sequence[PlatformState]) -> np.ndarray:
    """Return a picture of an episode, uint8 `[240, 1440, 3]`.

    Args:
        track: the states of one environment at the start and after each action, columns `[1]`.
    """
    canvas = Canvas.for_shapes(1440, _HEIGHT)
    for left, right in zip(rules.LEFT, rules.RIGHT, strict=True):
        corners = [(left, 0.0), (right, 0.0), (right, -_DEPTH / _SCALE), (left, -_DEPTH / _SCALE)]
        canvas.polygon([_on_paper(x, y) for x, y in corners], _GROUND)
    last = track[-1]
    middles = [float(state.x) + rules.BODY_WIDTH / 2.0 for state in track]
    path = [_on_paper(middle, 60.0) for middle in middles]
    canvas.way(path, _PATH)
    for place in path:
        canvas.disc(place, 2.6, _PATH)
    for enemy in _enemies(track):
        _draw_body(canvas, enemy, _ENEMY, 0.0)
    has_fallen = int(last.outcome) == rules.FELL
    _draw_body(canvas, float(last.x), _AGENT, -rules.BODY_HEIGHT if has_fallen else 0.0)
    finished = canvas.smoothed()
    finished.caption(int(last.steps), int(last.outcome), rules.OUTCOMES, word="action", top=14.0, bottom=14.0)
    finished.write((PAPER / 2.0, 14.0), f"{100.0 * float(last.x) / rules.END:.0f} % of the course", INK, anchor="mm")
    return np.array(finished.image)


def _enemies(track: Sequence[PlatformState]) -> list[float]:
    """Return where the enemies are, px.

    The state has one of them. The second waits at its start; the first is shown where it was before the agent left it.
    """
    on_first = [state for state in track if float(state.x) <= rules.LEFT[1]]
    if len(on_first) == len(track):
        return [float(track[-1].enemy_x), rules.SECOND_START]
    return [*(float(state.enemy_x) for state in on_first[-1:]), float(track[-1].enemy_x)]


def _on_paper(x: float, y: float) -> tuple[float, float]:
    """Map px of the course, y up from the platforms' tops, to units of paper."""
    return _LEFT + x * _SCALE, _TOP - y * _SCALE


def _draw_body(canvas: Canvas, x: float, colour: str, y: float) -> None:
    right, top = x + rules.BODY_WIDTH, y + rules.BODY_HEIGHT
    canvas.polygon([_on_paper(*corner) for corner in ((x, y), (right, y), (right, top), (x, top))], colour)
