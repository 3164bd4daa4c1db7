"""The settings and the card of the office."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemFacts, ProblemOptions
from hpamdp.settings import Fraction

GOALS = ("coffee", "mail", "target")


class OfficeOptions(ProblemOptions):
    """Settings of `OfficeEnv`. The defaults are the source's rules."""

    max_steps: PositiveInt = 400
    """Steps after which an episode is truncated."""
    slip: Fraction = 0.1
    """Probability that a move slips to the other axis."""
    tiles: Annotated[int, Field(ge=0, le=100)] = 0
    """Number of tiles along each axis that the agent observes beside its position, `[N, 4 + 2 tiles]`.

    A tile is 1 in its middle and falls to 0 at the middle of its neighbours. With them a network may tell places apart
    more easily.
    """
    chooses_goal: bool = False
    """Whether the agent chooses what it goes for next, as an option: coffee, mail or target. It takes nothing else.

    A goal is open while the agent lacks it; the target is open once it has both. `option_mask` says which ones are.
    An agent that has reached its goal and still holds the option goes for the first open one.
    """

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem; the default options are the axes."""
        if self.chooses_goal:
            return ProblemFacts(title=title, option_names=GOALS, has_choice=True, has_oracle=True)
        axes = {"upright": ["up", "down"], "level": ["left", "right"]}
        return ProblemFacts(title=title, default_options=axes, has_oracle=True)


CARDS = {
    "OfficeEnv": ProblemCard(
        options=OfficeOptions, choice_setting="env.chooses_goal=true", no_choice_setting="env.chooses_goal=false"
    ),
}
