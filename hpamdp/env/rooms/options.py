"""The settings and the card of rooms."""

from __future__ import annotations

from pydantic import PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemFacts, ProblemOptions


class RoomsOptions(ProblemOptions):
    """Settings of `RoomsEnv`."""

    max_steps: PositiveInt = 50
    """Steps after which an episode is truncated."""

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem: the agent chooses between skates and boots."""
        return ProblemFacts(title=title, option_names=("skates", "boots"), has_choice=True)


CARDS = {
    "RoomsEnv": ProblemCard(options=RoomsOptions),
}
