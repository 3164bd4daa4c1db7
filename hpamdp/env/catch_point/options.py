"""The settings and the card of Catch Point."""

from __future__ import annotations

from typing import Literal

from pydantic import PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemFacts, ProblemOptions

PUBLISHED_CATCHES = 11


class CatchPointOptions(ProblemOptions):
    """Settings of `CatchPointEnv`. The defaults are HyAR's version."""

    max_steps: PositiveInt = 25
    """Steps after which an episode is truncated."""
    catches: PositiveInt = PUBLISHED_CATCHES
    """Catches that an episode allows. The published code allows 11, its papers say 10."""
    late_end: bool = True
    """Whether an episode without catches ends one step late, with reward 0, as in the published code."""
    progress: bool = False
    """Whether the agent observes its misses and the time, `[N, 6]` instead of `[N, 4]`, as in DLPA's code."""
    observation: Literal["vector", "picture"] = "vector"
    """Whether the agent observes a vector, or the same drawn as a picture, uint8 `[N, 12288]` (`[3, 64, 64]`)."""

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem, which errors call `title`."""
        return ProblemFacts(title=title, has_oracle=True, has_pictures=self.observation == "picture")


CARDS = {
    "CatchPointEnv": ProblemCard(options=CatchPointOptions),
}
