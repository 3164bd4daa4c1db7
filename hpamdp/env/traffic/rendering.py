"""Pictures of the network: its roads, the lights at the stop lines, and the vehicles, red if they wait."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from hpamdp.env.canvas import BAD_EDGE, FAINT, GOOD_EDGE, INK, PAPER, Canvas, Point
from hpamdp.env.traffic.network import ARMS, NETWORKS, NUM_LANES
from hpamdp.env.traffic.options import PHASES
from hpamdp.env.traffic.simulation import Scene

OnPaper: TypeAlias = Callable[[float, float], Point]

_ROAD, _MOVING, _WAITING = "#d8d5cc", "#2f6690", "#b9503a"
_LIGHTS = {"G": GOOD_EDGE, "y": "#d9a400", "r": BAD_EDGE}
_LIGHT_WIDTH = 2.2  # units of paper
_LANE_M = 3.2
_BETWEEN_M = 300.0  # from one crossing to the next
_ARM_M = {"crossing": 130.0, "corridor": 290.0}  # how much of the outer arms is shown
# Unit vectors from a crossing along its arms.
_ALONG = ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))


def draw(network: str, scene: Scene, size: int = 480) -> np.ndarray:
    """Return a picture of the traffic at a decision, uint8 `[size, size, 3]`.

    Args:
        network: one of `NETWORKS`.
        scene: what is to be seen.
        size: of the picture, px.
    """
    canvas = Canvas.for_shapes(size)
    signals = NETWORKS[network]
    arm_m = _ARM_M[network]
    middle = 0.5 * _BETWEEN_M * (len(signals) - 1)
    scale = 0.5 * PAPER / (middle + arm_m)

    def on_paper(x: float, y: float) -> Point:
        return PAPER / 2.0 + (x - middle) * scale, PAPER / 2.0 - y * scale

    half = NUM_LANES * _LANE_M
    last = _BETWEEN_M * (len(signals) - 1)
    _band(canvas, on_paper(-arm_m, half), on_paper(last + arm_m, -half))
    for number in range(len(signals)):
        x = _BETWEEN_M * number
        _band(canvas, on_paper(x - half, arm_m), on_paper(x + half, -arm_m))
    for x, y, is_waiting in scene.vehicles.tolist():
        if max(abs(x - middle) - middle, abs(y)) < arm_m:
            canvas.disc(on_paper(x, y), max(1.5 * scale, 1.8), _WAITING if is_waiting else _MOVING)
    for number, state in enumerate(scene.lights):
        for arm in range(len(ARMS)):
            ahead, left = state[4 * arm + 1], state[4 * arm + 3]
            _light(canvas, on_paper, (number, arm), (0.0, 1.0), _LIGHTS[left])
            _light(canvas, on_paper, (number, arm), (1.0, 3.0), _LIGHTS[ahead])
    finished = canvas.smoothed()
    minutes, seconds = divmod(scene.time_s, 60)
    waiting = int(scene.vehicles[:, 2].sum()) + scene.num_outside
    finished.write((18.0, 22.0), f"{minutes}:{seconds:02d}", FAINT)
    finished.write((18.0, PAPER - 20.0), ", ".join(PHASES[phase] for phase in scene.phases), FAINT, 12.0)
    finished.write((PAPER - 18.0, 22.0), f"{waiting} vehicles wait", INK, anchor="rm")
    return np.array(finished.image)


def _band(canvas: Canvas, corner: Point, opposite: Point) -> None:
    (left, top), (right, bottom) = corner, opposite
    canvas.polygon([(left, top), (right, top), (right, bottom), (left, bottom)], _ROAD)


def _light(canvas: Canvas, on_paper: OnPaper, place: tuple[int, int], lanes: tuple[float, float], colour: str) -> None:
    """Draw the light of some lanes across them at the stop line.

    Args:
        canvas: to draw on.
        on_paper: from m to units of paper.
        place: numbers of the signal and of the arm.
        lanes: from the middle of the road, in lanes.
        colour: of the light.
    """
    number, arm = place
    x, y = _ALONG[arm]
    stop_m = NUM_LANES * _LANE_M + 4.0
    # Vehicles keep to the right, so those that come in on an arm are on its left side, seen from the crossing.
    start, end = (
        on_paper(_BETWEEN_M * number + stop_m * x - _LANE_M * lane * y, stop_m * y + _LANE_M * lane * x)
        for lane in (lanes[0] + 0.25, lanes[1] - 0.25)
    )
    canvas.line(start, end, colour, _LIGHT_WIDTH)
