"""The settings and the card of Hard Move."""

from __future__ import annotations

import itertools
import math
from typing import Literal

from pydantic import PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemFacts, ProblemOptions


def quadrants(n: int, *, rounded: bool) -> dict[str, list[int]]:
    """Return the sets of actuators that push into each quadrant. Sets whose pushes cancel are in `north_east`."""
    pushing = directions(n, rounded)
    numbers: dict[str, list[int]] = {name: [] for name in ("north_east", "north_west", "south_west", "south_east")}
    for number, members in enumerate(itertools.product((False, True), repeat=n)):
        pushes = list(itertools.compress(pushing, members))
        east, north = (sum(push[axis] for push in pushes) >= 0.0 for axis in (0, 1))
        numbers[f"{'north' if north else 'south'}_{'east' if east else 'west'}"].append(number)
    return numbers


def directions(n: int, rounded: bool) -> list[tuple[float, float]]:
    """Return the actuators' directions."""
    angles = [2.0 * math.pi * i / n for i in range(n)]
    exact = [(math.cos(angle), math.sin(angle)) for angle in angles]
    return [(round(x, 3), round(y, 3)) for x, y in exact] if rounded else exact


class HardMoveOptions(ProblemOptions):
    """Settings of `HardMoveEnv`. The defaults are HyAR's version."""

    n: Literal[4, 6, 8, 10] = 4
    """Number of actuators."""
    max_steps: PositiveInt = 30
    """Steps after which an episode is truncated. HyAR has 30, DLPA's code 25."""
    rounded_directions: bool = True
    """Whether the actuators' directions are rounded to three decimals, as in the published code."""

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem, which errors call `title`.

        The default options are the quadrants into which sets push with a positive parameter. Sets that push nowhere
        belong to the first quadrant.
        """
        groups = quadrants(self.n, rounded=self.rounded_directions)
        return ProblemFacts(title=title, default_options=groups, has_oracle=True)


CARDS = {
    "HardMoveEnv": ProblemCard(options=HardMoveOptions),
}
