"""The settings and the cards of explorations."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator
from typing_extensions import Self

from hpamdp.cards import ExplorationCard
from hpamdp.settings import Fraction, FromList, LearningRate, OnlyWith, Schedule, Settings, Widths

_COARSEST, _FINEST = 1e-12, 1e6  # resolutions in float32; finer cells of observations above 1e6 overflow int64


def _check_resolution(resolution: float | tuple[float, ...]) -> float | tuple[float, ...]:
    numbers = resolution if isinstance(resolution, tuple) else (resolution,)
    if not any(numbers):
        raise ValueError("must have a number above 0, or all states are one cell")
    if not all(number == 0.0 or _COARSEST <= number <= _FINEST for number in numbers):
        raise ValueError(f"must be from {_COARSEST:g} to {_FINEST:g}; in a list, 0 leaves an entry out")
    return resolution


class CountsOptions(Settings):
    """Settings of `Counts`."""

    weight: PositiveFloat = 0.01
    """Reward of a bonus of 1, in the unit of the problem's rewards. A bonus is n^-1/2 after n visits of a cell.

    A batch is counted before its bonuses: if ten environments enter a new cell in one batch, each gets 10^-1/2.
    """
    resolution: Annotated[
        PositiveFloat | Annotated[tuple[NonNegativeFloat, ...], FromList, Field(min_length=1)],
        AfterValidator(_check_resolution),
    ] = 10.0
    """Cells in a unit of each entry of the observation: entries are multiplied by it and rounded.

    With 1, an entry in [0, 1], such as a tile, has two cells, and an entry in [-1, 1] has three. A list has a number
    for each entry, and 0 leaves an entry out: `[10,10,0,0]` counts the places of a ball at any speed.
    """
    table_size: Annotated[int, Field(ge=1, le=10_000_000)] = 262_139
    """Slots in the table of counts, best a prime. Cells that share a slot share their count."""


class HeldOptions(Settings):
    """Settings of `Held`."""

    epsilon: Fraction = 0.05
    """Probability that a step begins a random action to hold, if none is held.

    With `mu=2`, a hold lasts six steps on average, so 0.05 makes a quarter of all steps held ones.
    """
    epsilon_final: Fraction | None = None
    """Probability after `epsilon_steps`; it falls linearly from `epsilon` to this value. If null, it stays."""
    epsilon_steps: Annotated[PositiveInt, OnlyWith("epsilon_final"), Schedule()] = 100_000
    """With `epsilon_final`: the learner's own steps, its warm-up included, within which the probability falls."""
    mu: Annotated[float, Field(gt=1.0, le=10.0)] = 2.0
    """Exponent of the lengths: the probability of n steps is proportional to n^-mu. Less gives longer holds."""
    longest: Annotated[int, Field(ge=1, le=1_000_000)] = 10_000
    """Largest number of steps of a hold."""

    @model_validator(mode="after")
    def _check_schedule(self) -> Self:
        if self.epsilon_final is not None and self.epsilon_final > self.epsilon:
            raise ValueError(f"epsilon_final={self.epsilon_final}: must be at most epsilon={self.epsilon}")
        return self


_OfNetworks = OnlyWith("in_plans", "auto", "distillation")  # an ensemble's disagreement takes no networks


class NoveltyOptions(Settings):
    """Settings of `Novelty`."""

    weight: PositiveFloat = 0.01
    """Reward of a bonus of 1, in the unit of the problem's rewards.

    A bonus is an error in standard deviations of all errors so far. With disagreement, it is the members' standard
    deviation in units of the usual change of the state in a step.
    """
    hidden_dims: Annotated[Widths, Field(min_length=1), _OfNetworks] = (64, 64)
    """Hidden layers of the random network and of the one that predicts it."""
    num_features: Annotated[PositiveInt, _OfNetworks] = 32
    """Outputs of the random network."""
    lr: Annotated[LearningRate, _OfNetworks] = 1e-3
    """Learning rate of the predicting network. With more, states are familiar sooner."""
    batch_size: Annotated[PositiveInt, _OfNetworks] = 128
    """Steps in an update of the predicting network, which learns from each collected step once."""
    largest: Annotated[PositiveFloat, _OfNetworks] = 5.0
    """Largest bonus before it is weighted, and largest normalised entry of an observation."""
    in_plans: Literal["auto", "disagreement", "distillation"] = "auto"
    """Bonus of learners that plan: an ensemble's `disagreement` about the next state, or random network `distillation`.

    `auto` takes the disagreement if there is such an ensemble. The disagreement gives no bonus in new places whose
    simple dynamics the ensemble predicts already.
    """


CARDS = {
    "Counts": ExplorationCard(options=CountsOptions, changes="rewards"),
    "Held": ExplorationCard(options=HeldOptions, changes="actions"),
    "Novelty": ExplorationCard(options=NoveltyOptions, changes="rewards"),
}
