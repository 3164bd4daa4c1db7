"""Pictures of circuits: a line for each wire, a sign for each gate, and how well the target is matched."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hpamdp.env.canvas import BACKGROUND, FAINT, INK, PAPER, Canvas
from hpamdp.env.circuit import gates, rules
from hpamdp.env.circuit.gates import Gate
from hpamdp.env.circuit.rules import CircuitState, Design

_BOX, _BOX_EDGE = "#d6e7ec", "#2f6690"
_LEFT, _RIGHT = 52.0, 24.0  # margins beside the wires
_COLUMNS = 12  # gates side by side; earlier ones leave the picture on the left
_SIZE = 26.0  # width and height of a gate's box
_WIRES_TOP, _WIRES_HEIGHT = 90.0, 220.0
_BAR = (52.0, 400.0, PAPER - 24.0, 414.0)  # of the similarity


def draw(track: Sequence[CircuitState], design: Design, size: int = 480) -> np.ndarray:
    """Return a picture of a circuit, uint8 `[size, size, 3]`.

    Args:
        track: the states of one environment at the start and after each gate, columns `[1]`.
        design: settings of the circuits.
        size: px from edge to edge.
    """
    canvas = Canvas.for_shapes(size)
    last = track[-1]
    used = [
        (design.gate_sets[int(state.gate_set)][int(state.gate)], float(state.angle))
        for state in track
        if int(state.gate) >= 0
    ]
    shown = [(gate, angle) for gate, angle in used if gate.kind != gates.STOP][-_COLUMNS:]
    heights = [_WIRES_TOP + _WIRES_HEIGHT * (wire + 0.5) / design.task.n for wire in range(design.task.n)]
    for height in heights:
        canvas.line((_LEFT, height), (PAPER - _RIGHT, height), FAINT, 1.5)
    labels = [_draw_gate(canvas, gate, _x(place), heights) for place, (gate, _) in enumerate(shown)]
    left, top, right, bottom = _BAR
    similarity = float(last.similarity)
    canvas.bar(_BAR, "#e4e0d6")
    canvas.bar((left, top, left + max(similarity, 0.04) * (right - left), bottom), _BOX_EDGE)
    finished = canvas.smoothed()
    for wire, height in enumerate(heights):
        finished.write((_LEFT - 12.0, height), f"q{wire}", FAINT, anchor="rm")
    for place, ((gate, angle), found) in enumerate(zip(shown, labels, strict=True)):
        for height in found:
            finished.write((_x(place), height), gate.name.split()[0].removeprefix("c").upper(), INK, 11.0, anchor="mm")
        if gate.angle is None:
            finished.write(
                (_x(place), _WIRES_TOP + _WIRES_HEIGHT), f"{math.degrees(angle):.0f}°", FAINT, 10.0, anchor="mm"
            )
    num = len([gate for gate, _ in used if gate.kind != gates.STOP])
    finished.caption(num, int(last.outcome), rules.OUTCOMES, word="gate")
    finished.write((left, top - 16.0), f"similarity {similarity:.3f}, cost {float(last.cost):.3f}", INK)
    return np.array(finished.image)


def _x(place: int) -> float:
    return _LEFT + (place + 0.5) * (PAPER - _LEFT - _RIGHT) / _COLUMNS


def _draw_gate(canvas: Canvas, gate: Gate, x: float, heights: Sequence[float]) -> list[float]:
    """Draw a gate, and return the heights at which its name is to be written."""
    taken = [height for wire, height in enumerate(heights) if gate.wires >> wire & 1]
    changed = [height for wire, height in enumerate(heights) if gate.flipped >> wire & 1]
    if len(taken) > 1:
        canvas.line((x, min(taken)), (x, max(taken)), _BOX_EDGE, 2.0)
    for height in set(taken) - set(changed):
        canvas.disc((x, height), 5.0, _BOX_EDGE)
    if gate.kind == gates.FLIP:
        for height in changed:
            canvas.disc((x, height), 11.0, BACKGROUND, _BOX_EDGE, 2.0)
            canvas.line((x - 11.0, height), (x + 11.0, height), _BOX_EDGE, 1.5)
            canvas.line((x, height - 11.0), (x, height + 11.0), _BOX_EDGE, 1.5)
        return []
    half = _SIZE / 2.0
    for height in changed:
        corners = [(x - half, height - half), (x + half, height - half), (x + half, height + half)]
        canvas.polygon([*corners, (x - half, height + half)], _BOX, _BOX_EDGE, 1.6)
    return changed
