"""The settings and the cards of callbacks."""

from __future__ import annotations

from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from hpamdp.cards import CallbackCard
from hpamdp.settings import Settings


class PatienceOptions(Settings):
    """Settings of `Patience`."""

    evaluations: PositiveInt = 10
    """Evaluations without an improvement after which training ends."""
    min_improvement: NonNegativeFloat = 0.0
    """Least difference to the best score so far that counts as an improvement. An equal score never does."""


class TimeLimitOptions(Settings):
    """Settings of `TimeLimit`."""

    minutes: PositiveFloat = 60.0
    """Minutes of training after which it ends, evaluations and the parts before a resumption included."""


CARDS = {
    "BestAgent": CallbackCard(),
    "Patience": CallbackCard(options=PatienceOptions, needs_evaluations=True),
    "TimeLimit": CallbackCard(options=TimeLimitOptions),
}
