"""Invalid actions are refused with one wording: the environment, what it got and what is allowed."""

from __future__ import annotations

import math

import pytest
import torch

from hpamdp.env.actions import check_action_values

DIMS = (2, 0, 1)


def check(discrete: list[int], parameters: list[list[float]], **names) -> None:
    check_action_values(torch.tensor(discrete), torch.tensor(parameters), DIMS, **names)


def test_parameters_of_other_discrete_actions_may_be_anything():
    check([0, 1, 2], [[0.5, -9.0, math.nan], [math.inf, math.nan, math.nan], [math.nan, math.nan, 1.0]])


def test_the_first_invalid_row_is_named_with_its_values_and_what_is_allowed():
    with pytest.raises(ValueError) as raised:
        check([0, 3, -1], [[0.5, 1.0, math.nan]] * 3)
    assert str(raised.value) == (
        "step: environment 1 got discrete=3 (allowed 0 to 2), "
        "parameters=[0.5, 1.0, nan] (those of the chosen action must be finite)"
    )


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(("discrete", "column"), [(0, 0), (0, 1), (2, 2)])
def test_the_parameters_of_the_chosen_action_must_be_finite(discrete, column, value):
    parameters = [1.0, 1.0, 1.0]
    parameters[column] = value
    with pytest.raises(ValueError, match=f"environment 0 got discrete={discrete} "):
        check([discrete], [parameters])


def test_a_problem_may_use_its_own_words():
    with pytest.raises(ValueError, match=r"got turn=7 \(allowed 0 to 2\), angles=\["):
        check([7], [[0.0, 0.0, 0.0]], names=("turn", "angles"))
