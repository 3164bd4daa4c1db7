"""Option types for fractions of a whole and for rates, checked when a config is read."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
PositiveFraction = Annotated[float, Field(gt=0.0, le=1.0)]
Expectile = Annotated[float, Field(ge=0.5, lt=1.0)]  # .5 is the mean


def _check_rate(rate: float) -> float:
    if not 0.0 < rate <= 1.0:
        raise ValueError("must be above 0 and at most 1")
    return rate


LearningRate = Annotated[float, AfterValidator(_check_rate)]
