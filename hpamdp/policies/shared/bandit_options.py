"""Settings that bandits share."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from hpamdp.cards import SelectorCard
from hpamdp.settings import Indices, OnlyWith, Settings


class BanditOptions(Settings):
    """Settings of a bandit's memory. Forgetting suits rewards that change while the low level learns."""

    memory: Literal["all", "discounted", "sliding_window"] = "discounted"
    """Which rewards count: `all` equally, recent ones more (`discounted`), or the last ones only (`sliding_window`)."""
    discount: Annotated[float, Field(gt=0.0, lt=1.0), OnlyWith("memory", "discounted")] = 0.999
    """With `memory=discounted`: factor on the weight of a reward for each later decision, for any option."""
    window: Annotated[PositiveInt, OnlyWith("memory", "sliding_window")] = 2000
    """With `memory=sliding_window`: number of decisions that count, for all options together."""


class SessionBanditOptions(BanditOptions):
    """Settings of a bandit that may count the rewards of a session alone."""

    memory: Literal["all", "discounted", "sliding_window", "session"] = "discounted"  # type: ignore[assignment]
    """Which rewards count: `all` equally, recent ones more (`discounted`), or the last ones only (`sliding_window`).

    `session`: those of the session's earlier trips, if an episode is a session of trips. Each session begins anew.
    """


class LinearBanditOptions(BanditOptions):
    """Settings of linear bandits; `memory`, `discount` and `window` say which decisions count."""

    discount: Annotated[float, Field(gt=0.0, lt=1.0), OnlyWith("memory", "discounted")] = 0.998
    """With `memory=discounted`: factor on the weight of a reward for each later decision, for any option.

    It counts about the last 500 decisions. Earlier rewards are those of weaker learners.
    """
    features: Literal["auto", "projections", "polynomial", "random_fourier"] = "auto"
    """What rewards are linear in.

    `projections`: those of the vectors that the problem declares on the directions of each option's actions.
    `polynomial`: monomials of the inputs up to `degree`. `random_fourier`: `degree` cosines in random directions.
    `auto`: projections if the problem declares directions for each option, and neither `inputs` nor `degree` is given;
    else a polynomial.
    """
    inputs: Indices | None = None
    """Indices of the observation entries in the polynomial or the cosines. If null, all."""
    degree: PositiveInt = 1
    """Degree of the polynomial, or number of the cosines."""
    ridge: PositiveFloat = 1.0
    """Number added to the diagonal of each option's Gram matrix."""
    exploration: PositiveFloat = 1.0
    """Factor of the prediction's standard deviation in exploring choices."""


BANDIT_CARD = SelectorCard(is_bandit=True, takes_pictures=True)
LINEAR_BANDIT_CARD = SelectorCard(is_bandit=True, sees_state=True)
