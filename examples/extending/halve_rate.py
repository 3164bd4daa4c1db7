"""Define a custom callback: it halves all learning rates whenever the score stops improving."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from pydantic import PositiveInt

from hpamdp.cards import CallbackCard
from hpamdp.run.callbacks import Callback
from hpamdp.run.trainer import Trainer
from hpamdp.settings import Settings


class HalveRateOptions(Settings):
    """Settings of `HalveRate`."""

    evaluations: PositiveInt = 2
    """Evaluations without a higher score after which the learning rates are halved."""


class HalveRate(Callback):
    """Halve all learning rates after some evaluations without a higher score."""

    Options = HalveRateOptions
    card = CallbackCard(needs_evaluations=True)

    def __init__(self, options: HalveRateOptions | None = None, **settings: Any) -> None:
        self.options: HalveRateOptions = HalveRateOptions.of(options, settings)
        self.best = -math.inf
        self.waited = 0

    def on_evaluation(self, trainer: Trainer, row: Mapping[str, float]) -> None:
        """Count the evaluation, and halve the learning rates if the count is reached."""
        is_better = row["eval/score"] > self.best
        self.best = max(self.best, row["eval/score"])
        self.waited = 0 if is_better else self.waited + 1
        if self.waited == self.options.evaluations:
            self.waited = 0
            for group in self._groups(trainer):
                group["lr"] /= 2

    def metrics(self, trainer: Trainer) -> Mapping[str, float]:
        """Return the highest learning rate, which becomes the column `own/lr`."""
        return {"lr": max((group["lr"] for group in self._groups(trainer)), default=0.0)}

    def state(self) -> dict[str, Any]:
        """Return what a resumed run has to know. The optimizers save their learning rates themselves."""
        return {"best": self.best, "waited": self.waited}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`."""
        self.best, self.waited = state["best"], state["waited"]

    def _groups(self, trainer: Trainer) -> list[dict[str, Any]]:
        parts = trainer.parts.agent.stateful().values()
        return [group for part in parts if isinstance(part, torch.optim.Optimizer) for group in part.param_groups]
