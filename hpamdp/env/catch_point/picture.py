"""Draw the observation of Catch Point as a picture of 64 x 64 pixels.

The picture is drawn from the vector that the agent would otherwise observe, so both hold the same. The camera follows
the agent, which is in the middle; +y is up.

- Red: the target, a disc with the radius that counts as a hit. The view spans 2.56 to each side. If the target is
  further than 2.24 along x or y, the view widens, and the disc is smaller by the same factor.
- Green: the agent; with `progress` also two bars, at the top the time and at the bottom the misses.
- Blue: the velocity, a line from the agent, 25 px for a velocity of 1.

Edges are smooth, so a shift by a fraction of a pixel shows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hpamdp.env import point_agent
from hpamdp.env.kernels import HALF, ONE, ZERO, kernel, part

SIZE = 64
SHAPE = (3, SIZE, SIZE)

_F = np.float32
_RED, _GREEN, _BLUE = range(3)
_WHITE, _WHOLE = _F(255.0), _F(SIZE)
_MIDDLE = _F(0.5 * SIZE)
_SCALE = _F(0.5 * SIZE / 2.56)  # px for a length of 1, unless the view widens
_FARTHEST = _F(0.5 * SIZE - 4.0)  # px from the middle, where the target's centre stays in a widened view
_TARGET, _AGENT, _LINE = _F(point_agent.HIT_RADIUS) * _SCALE, _F(2.0), _F(1.0)  # radii in px
_PER_SPEED = _F(25.0)
_BAR = 3  # px from top to bottom of a bar


@part
def _draw_stroke(layer: Any, x: Any, y: Any, dx: Any, dy: Any, radius: Any) -> None:
    """Draw all within `radius` of the line from (x, y) to (x + dx, y + dy), px from the top left corner."""
    reach = radius + ONE
    left, right = max(0, int(min(x, x + dx) - reach)), min(SIZE, int(max(x, x + dx) + reach) + 1)
    top, bottom = max(0, int(min(y, y + dy) - reach)), min(SIZE, int(max(y, y + dy) + reach) + 1)
    squared = dx * dx + dy * dy
    for i in range(top, bottom):
        to_y = _F(i) + HALF - y
        for j in range(left, right):
            to_x = _F(j) + HALF - x
            along = min(max((to_x * dx + to_y * dy) / squared, ZERO), ONE) if squared > ZERO else ZERO
            off_x, off_y = to_x - along * dx, to_y - along * dy
            inside = radius + HALF - _F(np.sqrt(off_x * off_x + off_y * off_y))
            layer[i, j] = np.uint8(_WHITE * min(max(inside, ZERO), ONE) + HALF)


@part
def _draw_bar(layer: Any, top: Any, fraction: Any) -> None:
    """Draw a bar from the left edge over a fraction of the width."""
    length = min(max(fraction, ZERO), ONE) * _WHOLE
    for j in range(SIZE):
        layer[top : top + _BAR, j] = np.uint8(_WHITE * min(max(length - _F(j), ZERO), ONE) + HALF)


@kernel
def draw(observations: Any, longest_time: Any, most_misses: Any, pictures: Any) -> None:
    """Draw observations float32 `[N, 4]`, or `[N, 6]` with `progress`, into pictures uint8 `[N, 3, 64, 64]`.

    The full lengths of the bars stand for `longest_time` and `most_misses`, the highest values of these two entries;
    their lowest is -1.
    """
    for row in range(len(observations)):
        seen, layers = observations[row], pictures[row]
        layers[:] = 0
        farthest = max(abs(seen[2]), abs(seen[3])) * _SCALE
        zoom = _FARTHEST / farthest if farthest > _FARTHEST else ONE
        scale = zoom * _SCALE
        _draw_stroke(layers[_RED], _MIDDLE + scale * seen[2], _MIDDLE - scale * seen[3], ZERO, ZERO, zoom * _TARGET)
        _draw_stroke(layers[_GREEN], _MIDDLE, _MIDDLE, ZERO, ZERO, _AGENT)
        _draw_stroke(layers[_BLUE], _MIDDLE, _MIDDLE, _PER_SPEED * seen[0], -_PER_SPEED * seen[1], _LINE)
        if len(seen) > 4:
            _draw_bar(layers[_GREEN], 0, (seen[5] + ONE) / (longest_time + ONE))
            _draw_bar(layers[_GREEN], SIZE - _BAR, (seen[4] + ONE) / (most_misses + ONE))
