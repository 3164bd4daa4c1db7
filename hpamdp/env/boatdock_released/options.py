"""The settings and the card of the boats with the rules of the released code."""

from __future__ import annotations

from typing import Literal

from pydantic import PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemOptions


class ReleasedBoatDockOptions(ProblemOptions):
    """Settings of `ReleasedBoatDockEnv`."""

    controller: Literal["congruent", "incongruent"] = "congruent"
    """The controller. The agent cannot choose it, so use high=none."""
    keymap: Literal[0, 1] = 0
    """Key map of the incongruent controller. If 0, it is sampled from {0, 1} at every reset until it is 1.

    Key map 0 has the keys of key map 2 in env=boatdock. The congruent controller observes -1.
    """
    test_mode: Literal[0, 1, None] = None
    """If 1, only layouts with a bearing within 30 degrees of the incongruent controller's directions.

    If 0, only the other layouts. If null, all layouts.
    """
    frozen_layouts: bool = True
    """Keep the layout of the first reset for all episodes, as released. If false, every episode has a new layout."""
    observation: Literal["pixels", "scaled"] = "pixels"
    """`pixels` `[N, 15]` as released, or `scaled` `[N, 17]` to about [-1, 1] with goal - boat appended.

    If scaled, fuel is log(1 + fuel / 5).
    """
    max_steps: PositiveInt = 999
    """Number of steps after which an episode is truncated. The released code uses 999."""


CARDS = {
    "ReleasedBoatDockEnv": ProblemCard(options=ReleasedBoatDockOptions),
}
