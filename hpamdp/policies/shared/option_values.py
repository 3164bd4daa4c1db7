"""Settings that selectors share which learn values of options off-policy."""

from __future__ import annotations

from typing import Annotated

from pydantic import PositiveInt, model_validator
from typing_extensions import Self

from hpamdp.settings import Fraction, LearningRate, OwnSteps, PositiveFraction, Settings, Widths


class OptionValueOptions(Settings):
    """Settings of option values that are learned from a replay buffer."""

    hidden_dims: Widths = (128, 128)
    """Hidden layers of each network."""
    gamma: PositiveFraction = 0.99
    """Discount of an environment step, both within an option's return and for what follows the option."""
    epsilon_final: Annotated[Fraction, OwnSteps()] = 0.1
    """Probability of a random option at the end of its linear decay from 1."""
    buffer_size: PositiveInt = 50_000
    """Number of decisions, or of steps, that are stored. Old ones mislead, since the learners improve."""
    batch_size: PositiveInt = 128
    """Number of stored decisions, or of steps, in an update."""
    max_updates: Annotated[PositiveInt, OwnSteps()] = 64
    """Largest number of updates between two collected batches."""
    lr: LearningRate = 1e-3
    """Learning rate of Adam for the option values."""
    tau: PositiveFraction = 0.01
    """Fraction of the way to the learned network that the target network moves after each update."""

    @model_validator(mode="after")
    def _check_sizes(self) -> Self:
        if self.batch_size > self.buffer_size:
            raise ValueError(f"batch_size={self.batch_size}: must be at most buffer_size={self.buffer_size}")
        return self
