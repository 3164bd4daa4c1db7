"""Smooth drawing in NumPy pictures, for `render`."""

from __future__ import annotations

from functools import lru_cache

from PIL import Image, ImageDraw, ImageFont

Point = tuple[float, float]

BACKGROUND = "#f6f4ef"
INK = "#2d3e48"
FAINT = "#7d8b92"
GOOD, GOOD_EDGE = "#c3e3c6", "#3c8a55"
BAD, BAD_EDGE = "#f1cbbd", "#b9503a"

# Shapes are drawn SMOOTH times too large and averaged down. Text is written afterwards: Pillow smooths it itself.
SMOOTH = 3
PAPER = 480.0  # units of paper from edge to edge, whatever the size of the picture


class Canvas:
    """A picture addressed in units of paper, so that the same code draws every size."""

    def __init__(self, image: Image.Image) -> None:
        self.image = image
        self._pen = ImageDraw.Draw(image)
        self._unit = image.width / PAPER

    def disc(self, centre: Point, radius: float, fill: str, edge: str | None = None, width: float = 0.0) -> None:
        """Draw a disc."""
        x, y, r = (self._unit * value for value in (*centre, radius))
        self._pen.ellipse((x - r, y - r, x + r, y + r), fill, edge, round(width * self._unit))

    def line(self, start: Point, end: Point, colour: str, width: float) -> None:
        """Draw a line with round ends."""
        self._pen.line([self._unit * value for value in (*start, *end)], colour, round(width * self._unit))
        for point in (start, end):
            self.disc(point, width / 2.0, colour)

    def polygon(self, points: list[Point], fill: str, edge: str | None = None, width: float = 0.0) -> None:
        """Draw a polygon."""
        scaled = [(self._unit * x, self._unit * y) for x, y in points]
        self._pen.polygon(scaled, fill, edge, round(width * self._unit))

    def bar(self, box: tuple[float, float, float, float], colour: str) -> None:
        """Draw a bar with round ends; `box` is left, top, right, bottom."""
        radius = min(box[2] - box[0], box[3] - box[1]) / 2.0
        self._pen.rounded_rectangle([self._unit * value for value in box], radius * self._unit, colour)

    def write(self, place: Point, text: str, colour: str = INK, size: float = 14.0, anchor: str = "lm") -> None:
        """Write a line of text; `anchor` as Pillow has it, `lm` for the middle of the left edge."""
        x, y = place
        self._pen.text((x * self._unit, y * self._unit), text, colour, _font(size * self._unit), anchor)


@lru_cache(maxsize=4)
def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
