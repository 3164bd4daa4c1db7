"""Code that a run calls during training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hpamdp.run.train import Trainer


class Callback:
    """Called during training. A subclass overrides the methods that it needs.

    Each method gets the trainer. `trainer.stop()` ends training after the current batch. The callback can read
    `trainer.frames`, `trainer.wall_s`, `trainer.last_score`, `trainer.parts.agent` and
    `trainer.recorder.metrics.rows()`.
    """

    def on_batch(self, trainer: Trainer) -> None:
        """Act after the agent has learned from a batch."""

    def on_evaluation(self, trainer: Trainer, row: Mapping[str, float]) -> None:
        """Act after an evaluation.

        Args:
            trainer: the running training.
            row: the new row of metrics. Names of evaluated figures begin with `eval/`.
        """

    def on_end(self, trainer: Trainer) -> None:
        """Act after the last batch, before the agent is saved."""
