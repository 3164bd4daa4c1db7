"""Pictures of an episode: the harbour, the dock, the boat with its track, the fuel and the keys."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from torch import Tensor

from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.task import Boats, BoatState
from hpamdp.env.canvas import BACKGROUND, BAD, BAD_EDGE, FAINT, GOOD, GOOD_EDGE, INK, PAPER, Canvas, Point

_WATER = "#d6e7ec"
_RIM = "#a5c2cb"
_PRESSED = "#2f6690"
_GLIDE = "#86aecb"
_HULL = "#1d3f58"
_DOCK, _DOCK_EDGE = "#f4dfb0", "#c8963e"
_GAUGE_COLOUR = "#e3e1da"
_LOW_FUEL = 0.25  # below it the gauge turns red

_SCALE = 1.66  # units of paper per px of the harbour
_COMPASS = (54.0, 403.0)  # point where the arrows of the keys start
_ARROW = 26.0  # length of the arrows
_GAUGE = (346.0, 18.0, 462.0, 28.0)  # left, top, right, bottom


class Leg(NamedTuple):
    """The track of one press, px from the harbour's centre, and the fraction of it with the key down."""

    start: Point
    end: Point
    pressed: float


@dataclass(frozen=True)
class Scene:
    """The content of a picture. Positions are px from the harbour's centre, with y pointing down.

    Attributes:
        start, goal, boat: positions.
        heading: direction of the bow, of any length. (0, 0) before the first press.
        legs: the track so far.
        fuel: remaining fraction of the tank.
        presses: number of presses so far.
        controller: number of the boat, or -1 before the choice.
        keymap: 1 or 2.
        outcome: one of `physics.OUTCOMES`.
        score: score shown at the end of an episode. If None, none is shown.
        boats: boats that the numbers stand for. If None, people's two.
    """

    start: Point
    goal: Point
    boat: Point
    heading: Point = (0.0, 0.0)
    legs: tuple[Leg, ...] = ()
    fuel: float = 1.0
    presses: int = 0
    controller: int = harbour.NOT_CHOSEN
    keymap: int = 1
    outcome: str = physics.OUTCOMES[physics.SAILING]
    score: float | None = None
    boats: Boats | None = None


def draw(scene: Scene, size: int = 480) -> np.ndarray:
    """Return a picture of the scene, uint8 `[size, size, 3]`."""
    canvas = Canvas.for_shapes(size)
    canvas.disc(_on_paper((0.0, 0.0)), physics.HARBOUR_RADIUS * _SCALE + 1.5, _WATER, _RIM, 3.0)
    _draw_places(canvas, scene)
    _draw_track(canvas, scene)
    _draw_boat(canvas, scene)
    _draw_gauge(canvas, scene.fuel)
    _draw_compass(canvas, scene)
    finished = canvas.smoothed()
    _write_labels(finished, scene)
    return np.array(finished.image)


def _on_paper(point: Point) -> Point:
    """Map px from the harbour's centre to units of paper."""
    return PAPER / 2.0 + point[0] * _SCALE, PAPER / 2.0 + point[1] * _SCALE


def _along(start: Point, end: Point, fraction: float) -> Point:
    return start[0] + fraction * (end[0] - start[0]), start[1] + fraction * (end[1] - start[1])


def _colours(scene: Scene) -> tuple[str, str]:
    """Return the fill and edge colours that show the outcome."""
    if scene.outcome == physics.OUTCOMES[physics.SUCCESS]:
        return GOOD, GOOD_EDGE
    if scene.outcome == physics.OUTCOMES[physics.SAILING]:
        return _DOCK, _DOCK_EDGE
    return BAD, BAD_EDGE


def _draw_places(canvas: Canvas, scene: Scene) -> None:
    fill, edge = _colours(scene)
    goal = _on_paper(scene.goal)
    canvas.disc(goal, physics.DOCK_RADIUS * _SCALE, fill, edge, 1.6)
    canvas.disc(goal, 3.0, edge)


def _draw_track(canvas: Canvas, scene: Scene) -> None:
    for start, end, pressed in scene.legs:
        release = _on_paper(_along(start, end, pressed))
        canvas.line(release, _on_paper(end), _GLIDE, 2.0)
        canvas.line(_on_paper(start), release, _PRESSED, 3.2)
    for leg in scene.legs[1:]:
        canvas.disc(_on_paper(leg.start), 3.4, BACKGROUND, _PRESSED, 1.6)
    canvas.disc(_on_paper(scene.start), 5.4, BACKGROUND, INK, 2.0)


def _draw_boat(canvas: Canvas, scene: Scene) -> None:
    x, y = _on_paper(scene.boat)
    length = math.hypot(*scene.heading)
    if length == 0.0:
        canvas.disc((x, y), 7.0, _HULL, BACKGROUND, 1.6)
        return
    forward_x = scene.heading[0] / length
    forward_y = scene.heading[1] / length
    # The hull from above, starting at the bow: (forward, sideways) in units of paper.
    hull = [(13.0, 0.0), (7.5, 4.6), (0.0, 6.2), (-9.0, 5.0), (-9.0, -5.0), (0.0, -6.2), (7.5, -4.6)]
    turned = [(x + f * forward_x - s * forward_y, y + f * forward_y + s * forward_x) for f, s in hull]
    canvas.polygon(turned, _HULL, BACKGROUND, 1.6)
    canvas.disc((x - 3.0 * forward_x, y - 3.0 * forward_y), 2.4, BACKGROUND)


def _draw_gauge(canvas: Canvas, fuel: float) -> None:
    left, top, right, bottom = _GAUGE
    canvas.bar(_GAUGE, _GAUGE_COLOUR)
    if fuel > 0.0:
        # The bar is at least as wide as high, so that the round ends fit.
        width = max(fuel * (right - left), bottom - top)
        canvas.bar((left, top, left + width, bottom), _PRESSED if fuel >= _LOW_FUEL else BAD_EDGE)


def _directions(scene: Scene) -> tuple[Point, ...]:
    """Return the directions of the keys, or no directions before a controller is chosen."""
    if scene.controller == harbour.NOT_CHOSEN:
        return ()
    if scene.boats is not None:
        return scene.boats.directions[scene.controller]
    return harbour.DIRECTIONS[2 if scene.controller == harbour.CONGRUENT else scene.keymap - 1]


def _draw_compass(canvas: Canvas, scene: Scene) -> None:
    x, y = _COMPASS
    for dir_x, dir_y in _directions(scene):
        neck = (x + (_ARROW - 6.0) * dir_x, y + (_ARROW - 6.0) * dir_y)
        canvas.line((x + 5.0 * dir_x, y + 5.0 * dir_y), neck, INK, 2.4)
        tip = (x + _ARROW * dir_x, y + _ARROW * dir_y)
        sides = [(neck[0] - s * dir_y, neck[1] + s * dir_x) for s in (-5.0, 5.0)]
        canvas.polygon([tip, *sides], INK)


def _write_labels(canvas: Canvas, scene: Scene) -> None:
    x, y = _COMPASS
    directions = _directions(scene)
    for number, (dir_x, dir_y) in enumerate(directions, start=1):
        canvas.write((x + (_ARROW + 10.0) * dir_x, y + (_ARROW + 10.0) * dir_y), str(number), size=13.0, anchor="mm")
    names = harbour.CONTROLLERS if scene.boats is None else scene.boats.names
    name = names[scene.controller] if directions else "no boat chosen"
    canvas.write((18.0, 463.0), name, INK if directions else FAINT)
    canvas.write((_GAUGE[0] - 8.0, 23.0), "fuel", FAINT, anchor="rm")
    canvas.write((462.0, 40.0), f"{100.0 * scene.fuel:.0f} %", FAINT, 12.0, anchor="rm")
    canvas.write((18.0, 23.0), f"{scene.presses} {'press' if scene.presses == 1 else 'presses'}", FAINT)
    if scene.outcome != physics.OUTCOMES[physics.SAILING]:
        colour = _colours(scene)[1]
        canvas.write((462.0, 463.0), scene.outcome.replace("_", " "), colour, 16.0, anchor="rm")
        if scene.score is not None:
            canvas.write((462.0, 441.0), f"score {scene.score:.2f}", INK, anchor="rm")


def fuel_at_press(before: BoatState, after: BoatState, switch_cost: float | None) -> Tensor:
    """Return the fuel (s) at the beginning of the press between two states of one boat.

    A change of boats takes its fuel before the press.
    """
    if switch_cost is None or before.controller.item() in (harbour.NOT_CHOSEN, after.controller.item()):
        return before.fuel
    return (before.fuel - switch_cost).clip(0.0)


def leg(before: BoatState, after: BoatState, switch_cost: float | None = None, strength: float = 1.0) -> Leg:
    """Return the track of the press between two states of one boat, `strength` times as fast as people's boats."""
    start = (before.x.item(), before.y.item())
    end = (after.x.item(), after.y.item())
    # The fuel burnt equals the time that the key was down, after noise and after the limit of the tank.
    burnt = fuel_at_press(before, after, switch_cost) - after.fuel
    pressed = strength * physics.pressed_distance(burnt).item()
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    return Leg(start, end, min(pressed / length, 1.0) if length > 0.0 else 1.0)
