"""The settings and the card of Minari's data sets."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from hpamdp.cards import DataCard
from hpamdp.settings import Settings


class MinariOptions(Settings):
    """Settings of `MinariDemonstrations`."""

    dataset: str = ""
    """Name of the data set, such as `hpamdp/platform/mixed-v0`; `hpamdp datasets` lists the package's own."""
    held_out: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Fraction of the episodes from which nothing learns, spread evenly over the data set.

    `hpamdp judge` learns from them alone. `metrics.csv` shows the learners' losses on them.
    """


CARDS = {"MinariDemonstrations": DataCard(options=MinariOptions)}
