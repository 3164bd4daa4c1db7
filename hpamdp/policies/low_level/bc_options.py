"""The settings and the card of behaviour cloning."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from pydantic import Field, NonNegativeFloat, PositiveInt

from hpamdp.cards import ActionFeature
from hpamdp.policies.shared.options import REPLAY_CARD, BufferOptions, HeadOptions, ScaleOptions
from hpamdp.settings import LearningRate, Widths


class BCOptions(HeadOptions, ScaleOptions, BufferOptions):
    """Settings of `BC`."""

    hidden_dims: Annotated[Widths, Field(min_length=1)] = (128, 128)
    """Hidden layers of the actor."""
    buffer_size: PositiveInt = 200_000
    """Largest number of transitions that are kept."""
    batch_size: PositiveInt = 512
    lr: LearningRate = 1e-3
    """Learning rate of AdamW."""
    weight_decay: NonNegativeFloat = 1e-2
    """Weight decay of AdamW."""


CARDS = {
    "BC": replace(
        REPLAY_CARD, options=BCOptions, modes=("offline",), takes=frozenset(ActionFeature), explores_with=frozenset()
    )
}
