"""Maps of Pinball: the two of the source, and the reader of other maps.

A map is a JSON file with the ball's radius, its start, the hole and the walls, all in the square [0, 1]²:

    {
      "ball": 0.02,
      "start": [0.2, 0.9],
      "target": [0.9, 0.2, 0.04],
      "polygons": [[[0.0, 0.0], [0.0, 0.01], [1.0, 0.01], [1.0, 0.0]]]
    }

`start` is x and y, `target` is x, y and the radius. A polygon is a list of at least three corners; its last corner is
connected to its first. The walls around the square are polygons like the others. Without them, a ball that leaves the
square is put back.
"""

from __future__ import annotations

import itertools
import math
import os
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hpamdp.env.pinball.options import SOURCE_MAPS
from hpamdp.files import read_regular
from hpamdp.json_lines import LineError, read_json
from hpamdp.messages import reason_of

_FOLDER = Path(__file__).resolve().parent / "maps"
_MAX_BYTES = 2**20
_SHORTEST_EDGE = 1e-6  # of a wall, in units of the square's side; shorter ones are lost to rounding in float32
_MAX_CORNERS = 2_000  # of all polygons: the rules compare every ball with every edge

Coordinate = Annotated[float, Field(ge=0.0, le=1.0)]
Point = tuple[Coordinate, Coordinate]
Radius = Annotated[float, Field(ge=0.001, le=0.25)]


class MapError(ValueError):
    """Raised for a file that is no map; the message is one line and names the file."""


class Edges(NamedTuple):
    """The E edges of all polygons, from corner to corner.

    Attributes:
        corner: where each edge begins, float64 `[E, 2]`.
        side: from there to its end, float64 `[E, 2]`.
        polygon: number of its polygon, int64 `[E]`.
    """

    corner: np.ndarray
    side: np.ndarray
    polygon: np.ndarray


class PinballMap(BaseModel):
    """The ball's radius, its start, the hole (x, y and radius) and the walls."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)

    ball: Radius
    start: Point
    target: tuple[Coordinate, Coordinate, Radius]
    polygons: Annotated[
        tuple[Annotated[tuple[Point, ...], Field(min_length=3, max_length=_MAX_CORNERS)], ...],
        Field(min_length=1, max_length=_MAX_CORNERS),
    ]

    def edges(self) -> Edges:
        """Return the edges of all polygons."""
        numbers = np.repeat(np.arange(len(self.polygons)), [len(polygon) for polygon in self.polygons])
        corners = [np.array(polygon, np.float64) for polygon in self.polygons]
        sides = [np.roll(polygon, -1, 0) - polygon for polygon in corners]
        return Edges(np.concatenate(corners), np.concatenate(sides), numbers)

    def clearance(self, points: np.ndarray) -> np.ndarray:
        """Return the distances of points `[M, 2]` from the nearest wall `[M]`, negative inside a wall."""
        edges = self.edges()
        distance = np.full(len(points), np.inf)
        is_inside = np.zeros((len(self.polygons), len(points)), np.bool_)
        for (x, y), (dx, dy), polygon in zip(edges.corner, edges.side, edges.polygon, strict=True):
            along = np.clip(((points[:, 0] - x) * dx + (points[:, 1] - y) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
            distance = np.minimum(distance, np.hypot(x + along * dx - points[:, 0], y + along * dy - points[:, 1]))
            if dy != 0.0:
                # A point is inside if a line from it to the right crosses an odd number of edges.
                is_beside = (y > points[:, 1]) != (y + dy > points[:, 1])
                is_inside[polygon] ^= is_beside & (points[:, 0] < x + (points[:, 1] - y) * dx / dy)
        return np.where(is_inside.any(0), -distance, distance)

    def free_places(self, num: int) -> np.ndarray:
        """Return the places of a grid of `num` x `num` where the ball lies free and outside the hole, `[P, 2]`."""
        middle = (np.arange(num) + 0.5) / num
        places = np.stack(np.meshgrid(middle, middle, indexing="ij"), -1).reshape(-1, 2)
        to_target = np.hypot(places[:, 0] - self.target[0], places[:, 1] - self.target[1])
        return places[(self.clearance(places) > self.ball) & (to_target >= self.target[2])]


def read(name: str) -> PinballMap:
    """Return one of the source's maps by its name, or the map in a file.

    Raises:
        MapError: the file is missing, too large, no JSON or no map.
    """
    path = _FOLDER / f"{name}.json" if name in SOURCE_MAPS else Path(os.path.expanduser(name))
    try:
        data = read_regular(path, _MAX_BYTES)
    except FileNotFoundError as error:
        raise MapError(f"there is no such file; use {', '.join(SOURCE_MAPS)} or the path of a JSON file") from error
    except OSError as error:
        raise MapError(reason_of(error)) from error
    try:
        read_json(data)
    except LineError as error:
        raise MapError(str(error)) from error
    try:
        found = PinballMap.model_validate_json(data)
    except ValidationError as error:
        wrong = error.errors(include_url=False, include_input=False, include_context=False)[0]
        raise MapError(f"{_place(wrong['loc'])}: {wrong['msg'].replace('Input should be', 'must be')}") from error
    _check(found)
    return found


def _place(location: tuple[Any, ...]) -> str:
    """Return a place in the file as text, such as `polygons[3][1][0]`."""
    first, *others = location or ("the map",)
    return "".join([str(first), *(f"[{other}]" for other in others)])[:80]


def _check(found: PinballMap) -> None:
    """Refuse what no single value shows to be wrong.

    Raises:
        MapError: the message says where.
    """
    if sum(map(len, found.polygons)) > _MAX_CORNERS:
        raise MapError(f"polygons: have {sum(map(len, found.polygons))} corners, but may have at most {_MAX_CORNERS}")
    for number, polygon in enumerate(found.polygons):
        for place, (corner, following) in enumerate(itertools.pairwise((*polygon, polygon[0]))):
            if math.dist(corner, following) < _SHORTEST_EDGE:
                raise MapError(f"polygons[{number}][{place}]: is less than {_SHORTEST_EDGE:g} from the next corner")
    x, y, radius = found.target
    if not (radius <= x <= 1.0 - radius and radius <= y <= 1.0 - radius):
        raise MapError(f"target: the circle around ({x:g}, {y:g}) with radius {radius:g} must lie inside the square")
    clearance, around_target = found.clearance(np.array([found.start, (x, y)], np.float64)).tolist()
    if around_target + radius <= found.ball:  # no place in the circle is farther from the walls
        raise MapError("target: lies in a wall or too close to walls, so that the ball cannot reach it")
    if clearance <= found.ball:
        where = f"{clearance:.3g} from a wall" if clearance > 0.0 else "inside a wall"
        raise MapError(f"start: lies {where}, but the ball has radius {found.ball:g}")
    if np.hypot(found.start[0] - x, found.start[1] - y) < radius:
        raise MapError("start: lies in the target")
