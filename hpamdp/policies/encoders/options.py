"""The settings and the cards of encoders."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveInt

from hpamdp.cards import EncoderCard
from hpamdp.settings import FromList, Settings

Channels = Annotated[tuple[PositiveInt, PositiveInt, PositiveInt], FromList]


class CNNOptions(Settings):
    """Settings of `CNN`."""

    net: Literal["auto", "nature", "impala"] = "auto"
    """`nature`: three convolutions. `impala`: three stages of residual blocks, slower.

    `auto`: `impala` for pictures below 36 px a side, which are too small for `nature`, else `nature`.
    """
    channels: Channels | None = None
    """Channels of the three layers or stages. If null, those of the papers.

    `nature`: [32, 64, 64]; `impala`: [16, 32, 32].
    """
    num_features: Annotated[int, Field(ge=1, le=65536)] | None = None
    """Number of features of a picture. If null, those of the papers: 512 for `nature`, 256 for `impala`."""


CARDS = {"CNN": EncoderCard(options=CNNOptions), "MLP": EncoderCard(flattens=True)}
