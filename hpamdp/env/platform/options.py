"""The settings and the card of Platform."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemFacts, ProblemOptions


class PlatformOptions(ProblemOptions):
    """Settings of `PlatformEnv`."""

    max_steps: PositiveInt = 200
    """Steps after which an episode is truncated."""
    noise: Annotated[float, Field(ge=0.0, le=100.0)] = 1.0
    """Factor on the published noise of jumps, of the agent's speed and of the enemies' speed; 0 means no noise."""

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem; the default options are run and jump."""
        return ProblemFacts(title=title, default_options={"run": ["run"], "jump": ["hop", "leap"]})


CARDS = {
    "PlatformEnv": ProblemCard(options=PlatformOptions),
}
