"""Callbacks for tests, named by the yaml files in tests/conf/callback."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from hpamdp.cards import CallbackCard
from hpamdp.run.callbacks import Callback


class Recording(Callback):
    """Counts batches in its state and its metric, which is NaN once `breaks_at` frames are reached."""

    def __init__(self, breaks_at: int = 0) -> None:
        self.breaks_at = breaks_at
        self.seen = 0

    def on_batch(self, trainer) -> None:
        self.seen += 1

    def metrics(self, trainer) -> Mapping[str, float]:
        return {"seen": math.nan if self.breaks_at and trainer.frames >= self.breaks_at else self.seen}

    def state(self) -> dict[str, Any]:
        return {"seen": self.seen}

    def set_state(self, state: Mapping[str, Any]) -> None:
        self.seen = state["seen"]


class Guarded(Callback):
    """Has a setting that a saved run must not choose alone."""

    card = CallbackCard(guarded_settings=("command",))

    def __init__(self, command: str = "") -> None:
        self.command = command


class Faulty(Callback):
    """Divides by 0 in one method, as soon as the run has `at` frames."""

    def __init__(self, method: str, at: int) -> None:
        self._at, self._frames = at, -1
        inherited = getattr(self, method)

        def faulty(*given):
            if given:
                self._frames = given[0].frames
            if self._frames >= self._at:
                return 1 / 0
            return inherited(*given)

        setattr(self, method, faulty)
        if method == "state":
            self.on_end = lambda trainer: setattr(self, "_frames", trainer.frames)
