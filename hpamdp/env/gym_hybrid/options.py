"""The settings and the cards of Moving and Sliding."""

from __future__ import annotations

from typing import Literal

from pydantic import PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemFacts, ProblemOptions

PUBLISHED_STEPS = 201


class VehicleOptions(ProblemOptions):
    """Settings of `MovingEnv` and `SlidingEnv`."""

    max_steps: PositiveInt = PUBLISHED_STEPS
    """Steps after which an episode ends."""
    limit: Literal["truncated", "terminated"] = "truncated"
    """If `terminated`, values stop at the time limit, as in the published code; if `truncated`, they bootstrap past it.

    The time is observed, and the reward at the limit is -1.
    """

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem, which errors call `title`."""
        return ProblemFacts(title=title, has_oracle=True)


CARDS = {name: ProblemCard(options=VehicleOptions) for name in ("MovingEnv", "SlidingEnv")}
