"""The settings and the card of Minari's data sets."""

from __future__ import annotations

from hpamdp.cards import DataCard
from hpamdp.settings import Settings


class MinariOptions(Settings):
    """Settings of `MinariDemonstrations`."""

    dataset: str = ""
    """Name of the data set, such as `hpamdp/platform/mixed-v0`; `hpamdp datasets` lists the package's own."""


CARDS = {"MinariDemonstrations": DataCard(options=MinariOptions)}
