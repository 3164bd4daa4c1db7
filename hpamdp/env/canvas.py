"""Antialiased drawing with Pillow, for `render`."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache

from PIL import Image, ImageDraw, ImageFont

Point = tuple[float, float]

BACKGROUND = "#f6f4ef"
INK = "#2d3e48"
FAINT = "#7d8b92"
GOOD, GOOD_EDGE = "#c3e3c6", "#3c8a55"
BAD, BAD_EDGE = "#f1cbbd", "#b9503a"

# Shapes are drawn SMOOTH times too large and then averaged down. Text is written afterwards, because Pillow smooths
# text itself.
SMOOTH = 3
PAPER = 480.0  # width of every picture in units of paper, and height of the square ones


class Canvas:
    """A picture addressed in units of paper, so the same code draws pictures of every size."""

    def __init__(self, image: Image.Image) -> None:
        self.image = image
        self._pen = ImageDraw.Draw(image)
        self._unit = image.width / PAPER

    @classmethod
    def for_shapes(cls, size: int, height: float = PAPER) -> Canvas:
        """Return an empty canvas for shapes. `smoothed` then returns one `size` px wide; `height` is in paper."""
        return cls(Image.new("RGB", (size * SMOOTH, round(size * SMOOTH * height / PAPER)), BACKGROUND))

    def smoothed(self) -> Canvas:
        """Return a canvas for labels, with the shapes averaged down."""
        return Canvas(self.image.reduce(SMOOTH))

    def disc(self, centre: Point, radius: float, fill: str, edge: str | None = None, width: float = 0.0) -> None:
        """Draw a disc."""
        x, y, r = (self._unit * value for value in (*centre, radius))
        self._pen.ellipse((x - r, y - r, x + r, y + r), fill, edge, round(width * self._unit))

    def line(self, start: Point, end: Point, colour: str, width: float) -> None:
        """Draw a line with round ends."""
        start_x, start_y, end_x, end_y = (self._unit * value for value in (*start, *end))
        r = 0.5 * width * self._unit
        self._pen.line((start_x, start_y, end_x, end_y), colour, round(width * self._unit))
        for x, y in ((start_x, start_y), (end_x, end_y)):
            self._pen.ellipse((x - r, y - r, x + r, y + r), colour)

    def way(self, places: Sequence[Point], colour: str, width: float = 2.0) -> None:
        """Draw lines from each place to the next."""
        for start, end in itertools.pairwise(places):
            self.line(start, end, colour, width)

    def polygon(self, points: list[Point], fill: str, edge: str | None = None, width: float = 0.0) -> None:
        """Draw a polygon."""
        scaled = [(self._unit * x, self._unit * y) for x, y in points]
        self._pen.polygon(scaled, fill, edge, round(width * self._unit))

    def bar(self, box: tuple[float, float, float, float], colour: str) -> None:
        """Draw a bar with round ends. `box` is (left, top, right, bottom)."""
        left, top, right, bottom = (self._unit * value for value in box)
        radius = min(right - left, bottom - top) / 2.0
        self._pen.rounded_rectangle((left, top, right, bottom), radius, colour)

    def write(self, place: Point, text: str, colour: str = INK, size: float = 14.0, anchor: str = "lm") -> None:
        """Write a line of text. `anchor` is Pillow's: `lm` is the middle of the left edge."""
        x, y = place
        self._pen.text((x * self._unit, y * self._unit), text, colour, _font(size * self._unit), anchor)

    def caption(
        self,
        steps: int,
        outcome: int,
        outcomes: Sequence[str],
        *,
        word: str = "step",
        top: float = 22.0,
        bottom: float = PAPER - 20.0,
    ) -> None:
        """Write the number of steps on the left and, if the episode is over, how it ended on the right.

        Args:
            steps: number of steps.
            outcome: number of the outcome: 0 if the episode goes on, 1 if it succeeded.
            outcomes: names of the outcomes.
            word: what a step is called.
            top, bottom: height of the steps and of the outcome.
        """
        self.write((18.0, top), f"{steps} {word if steps == 1 else f'{word}s'}", FAINT)
        if outcome:
            colour = GOOD_EDGE if outcome == 1 else BAD_EDGE
            self.write((PAPER - 18.0, bottom), outcomes[outcome], colour, 16.0, anchor="rm")


@lru_cache(maxsize=4)
def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)
