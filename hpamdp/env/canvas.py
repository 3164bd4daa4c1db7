"""Antialiased drawing with Pillow, for `render`."""

from __future__ import annotations

import itertools
import math
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
PAPER = 480.0  # width and height of every picture in units of paper
_TILE = 48 * SMOOTH  # width and height (px) of a tile, the unit of smoothing
_MARGIN = 2.0  # px by which Pillow may draw beyond a shape's outline


class Canvas:
    """A picture addressed in units of paper, so the same code draws pictures of every size."""

    def __init__(self, image: Image.Image) -> None:
        self.image = image
        self._pen = ImageDraw.Draw(image)
        self._unit = image.width / PAPER
        self._drawn_on: set[tuple[int, int]] = set()  # columns and rows of tiles
        self._last_tile = (image.width - 1) // _TILE

    @classmethod
    def for_shapes(cls, size: int) -> Canvas:
        """Return an empty canvas for shapes. `smoothed` then returns a canvas of `size` px for the labels."""
        return cls(Image.new("RGB", (size * SMOOTH, size * SMOOTH), BACKGROUND))

    def smoothed(self, earlier: Image.Image | None = None) -> Canvas:
        """Return a canvas for labels, with the shapes averaged down.

        Args:
            earlier: smoothed picture of the image with which this canvas started. If given, only the tiles drawn on
                since then are smoothed again.
        """
        if earlier is None:
            return Canvas(self.image.reduce(SMOOTH))
        smooth = earlier.copy()
        for column, row in self._drawn_on:
            left, top = column * _TILE, row * _TILE
            right, bottom = min(left + _TILE, self.image.width), min(top + _TILE, self.image.height)
            smooth.paste(self.image.reduce(SMOOTH, (left, top, right, bottom)), (left // SMOOTH, top // SMOOTH))
        return Canvas(smooth)

    def disc(self, centre: Point, radius: float, fill: str, edge: str | None = None, width: float = 0.0) -> None:
        """Draw a disc."""
        x, y, r = (self._unit * value for value in (*centre, radius))
        self._pen.ellipse((x - r, y - r, x + r, y + r), fill, edge, round(width * self._unit))
        self._note_drawn((x, x), (y, y), r)

    def line(self, start: Point, end: Point, colour: str, width: float) -> None:
        """Draw a line with round ends."""
        start_x, start_y, end_x, end_y = (self._unit * value for value in (*start, *end))
        r = 0.5 * width * self._unit
        self._pen.line((start_x, start_y, end_x, end_y), colour, round(width * self._unit))
        for x, y in ((start_x, start_y), (end_x, end_y)):
            self._pen.ellipse((x - r, y - r, x + r, y + r), colour)
        # Mark tiles piece by piece, because the box around a long slanted line is mostly empty.
        num_pieces = math.ceil(max(abs(end_x - start_x), abs(end_y - start_y), 1.0) / _TILE)
        step_x, step_y = (end_x - start_x) / num_pieces, (end_y - start_y) / num_pieces
        for piece in range(num_pieces):
            x, y = start_x + piece * step_x, start_y + piece * step_y
            self._note_drawn((x, x + step_x), (y, y + step_y), r)

    def way(self, places: Sequence[Point], colour: str, width: float = 2.0) -> None:
        """Draw lines from each place to the next."""
        for start, end in itertools.pairwise(places):
            self.line(start, end, colour, width)

    def polygon(self, points: list[Point], fill: str, edge: str | None = None, width: float = 0.0) -> None:
        """Draw a polygon."""
        scaled = [(self._unit * x, self._unit * y) for x, y in points]
        self._pen.polygon(scaled, fill, edge, round(width * self._unit))
        self._note_drawn([x for x, _ in scaled], [y for _, y in scaled], width * self._unit)

    def bar(self, box: tuple[float, float, float, float], colour: str) -> None:
        """Draw a bar with round ends. `box` is (left, top, right, bottom)."""
        left, top, right, bottom = (self._unit * value for value in box)
        radius = min(right - left, bottom - top) / 2.0
        self._pen.rounded_rectangle((left, top, right, bottom), radius, colour)
        self._note_drawn((left, right), (top, bottom))

    def _note_drawn(self, x: Sequence[float], y: Sequence[float], reach: float = 0.0) -> None:
        """Mark the tiles within `reach` px of the places (px) as drawn on."""
        columns = self._tiles(min(x) - reach, max(x) + reach)
        rows = self._tiles(min(y) - reach, max(y) + reach)
        self._drawn_on.update(itertools.product(columns, rows))

    def _tiles(self, low: float, high: float) -> range:
        """Return the columns or rows of tiles between two places (px)."""
        first, last = int(low - _MARGIN) // _TILE, int(high + _MARGIN) // _TILE
        return range(max(first, 0), min(last, self._last_tile) + 1)

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
