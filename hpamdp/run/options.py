"""The settings and the cards of callbacks and loggers."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from hpamdp.cards import CallbackCard, LoggerCard
from hpamdp.settings import Settings

Name = Annotated[str, Field(min_length=1)]


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


CARDS: dict[str, Any] = {
    "BestAgent": CallbackCard(),
    "Patience": CallbackCard(options=PatienceOptions, needs_evaluations=True),
    "TimeLimit": CallbackCard(options=TimeLimitOptions),
    "CSVLogger": LoggerCard(),
    "TensorboardLogger": LoggerCard(),
    "WandbLogger": LoggerCard(options=WandbOptions, guarded_settings=("entity", "mode=online")),
}
