"""Invalid actions are refused with one wording: the environment, what it got and what is allowed."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from hpamdp.components import Components
from hpamdp.env.actions import check_action_values
from hpamdp.env.gymnasium_checks import single_action

DIMS = (2, 0, 1)


def check(discrete: list[int], parameters: list[list[float]]) -> None:
    check_action_values(torch.tensor(discrete), torch.tensor(parameters), DIMS, Components((3,)))


def test_parameters_of_other_discrete_actions_may_be_anything():
    check([0, 1, 2], [[0.5, -9.0, math.nan], [math.inf, math.nan, math.nan], [math.nan, math.nan, 1.0]])


def test_the_first_invalid_row_is_named_with_its_values_and_what_is_allowed():
    with pytest.raises(ValueError) as raised:
        check([0, 3, -1], [[0.5, 1.0, math.nan]] * 3)
    assert str(raised.value) == (
        "step: environment 1 got discrete=3 (allowed 0 to 2), "
        "parameters=[0.5, 1.0, nan] (those of the chosen action must be finite)"
    )


@pytest.mark.parametrize(("discrete", "column", "value"), [(0, 0, math.nan), (0, 1, -math.inf), (2, 2, math.inf)])
def test_the_parameters_of_the_chosen_action_must_be_finite(discrete, column, value):
    parameters = [1.0, 1.0, 1.0]
    parameters[column] = value
    with pytest.raises(ValueError, match=f"environment 0 got discrete={discrete} "):
        check([discrete], [parameters])


NONE, ONE, PAIR = np.zeros(0), np.zeros(1), np.zeros(2)
WRONG = {
    "a number alone": (3, r"the action must be a tuple \(discrete, parameters\), but is a int"),
    "a fraction": ((0.5, (PAIR, NONE, ONE)), "discrete has type float64, but must be integer"),
    "a row": ((np.array([0]), (PAIR, NONE, ONE)), r"discrete has shape \[1\], but must be \[\]"),
    "an unknown one": ((3, (PAIR, NONE, ONE)), "discrete=3, but allowed are 0 to 2"),
    "too few": ((0, (PAIR, NONE)), "parameters must be a tuple of length 3, but is a tuple of length 2"),
    "all in one array": ((0, np.zeros(3)), "parameters must be a tuple of length 3, but is a ndarray"),
    "too many of one": ((0, (np.zeros(3), NONE, ONE)), r"parameters of action 0 has shape \[3\], but must be \[2\]"),
    "texts": ((2, (PAIR, NONE, ["a"])), "parameters of action 2 has type <U1, but must be a number"),
    "nan": ((2, (PAIR, NONE, np.array([math.nan]))), r"the parameters of action 2 are \[nan\], but must be finite"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_single_action_of_another_form_is_refused_in_one_line(kind):
    action, line = WRONG[kind]
    with pytest.raises(ValueError, match=f"^step: {line}$"):
        single_action(action, DIMS)


def test_a_single_action_is_its_number_and_its_own_parameters():
    for number in (2, np.int64(2), np.array(2)):
        chosen, own = single_action((number, (np.full(2, math.nan), NONE, [0.5])), DIMS)
        assert chosen == 2 and own.tolist() == [0.5], "those of other actions may be anything"
