"""The settings and the cards of loggers."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from hpamdp.cards import LoggerCard
from hpamdp.settings import Settings

Name = Annotated[str, Field(min_length=1)]


class WandbOptions(Settings):
    """Settings of `WandbLogger`. `project`, `entity`, `group` and `name` go to `wandb.init`."""

    project: Name | None = "hpamdp"
    """Project of the run. If null, wandb chooses."""
    entity: Name | None = None
    """User or team of the run. If null, wandb chooses."""
    group: Name | None = None
    """Group of runs to show together."""
    name: Name | None = None
    """Name of the run. If null, wandb chooses."""
    mode: Literal["auto", "offline", "online", "disabled"] = "auto"
    """If `auto`, `WANDB_MODE` decides. If that is not set, the mode is online with an API key and offline without."""


CARDS = {
    "CSVLogger": LoggerCard(),
    "TensorboardLogger": LoggerCard(),
    "WandbLogger": LoggerCard(options=WandbOptions, guarded_settings=("entity", "mode=online")),
}
