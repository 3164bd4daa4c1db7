"""The settings and the card of pinball."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemFacts, ProblemOptions

SOURCE_MAPS = ("simple", "hard")


class PinballOptions(ProblemOptions):
    """Settings of `PinballEnv`."""

    map: Annotated[str, Field(min_length=1)] = "simple"
    """A map of the source, `simple` or `hard`, or the path of a JSON file with a map of your own."""
    start: Literal["map", "anywhere"] = "map"
    """Where episodes begin: at the start of the `map`, or `anywhere` between the walls. The ball is at rest."""
    training_start: Literal["map", "anywhere", "both"] | None = None
    """Where the episodes of training begin; with `both`, half of them at the start of the map and half `anywhere`.

    If null, they begin where those of evaluation do, see `start`.
    """
    max_steps: PositiveInt = 600
    """Steps after which an episode is truncated."""
    tiles: Annotated[int, Field(ge=0, le=100)] = 0
    """Number of tiles along each axis that the agent observes beside its position, `[N, 4 + 2 tiles]`.

    A tile is 1 in its middle and falls to 0 at the middle of its neighbours. With them a network may tell the
    two sides of a thin wall apart more easily.
    """

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem; the default options are the two axes and none."""
        groups = {"horizontal": ["right", "left"], "vertical": ["up", "down"], "none": ["none"]}
        return ProblemFacts(title=title, default_options=groups, has_oracle=True)


CARDS = {
    "PinballEnv": ProblemCard(options=PinballOptions, guarded_settings=("map",), unguarded_values={"map": SOURCE_MAPS}),
}
