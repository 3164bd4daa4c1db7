"""ReleasedBoatDockEnv keeps the framework's contract: specs, batches, seeds, saved states, invalid inputs, results."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from released_players import FUEL, IDLE, InFloat64, X, Y, one, press
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.env.boatdock_released.environment import ReleasedBoatDockEnv
from hpamdp.env.boatdock_released.rules import OUT_OF_FUEL, SUCCESS, TIME_LIMIT, WALL


@pytest.mark.parametrize(
    ("kind", "controller", "observation"),
    [(ReleasedBoatDockEnv, "congruent", "pixels"), (InFloat64, "incongruent", "scaled")],
)
def test_all_tensors_are_as_the_specs_say(kind, controller, observation):
    check_env_specs(kind(5, controller=controller, observation=observation))


def test_the_action_spec_has_durations_from_minus_one_to_one():
    spec = ReleasedBoatDockEnv(2).full_action_spec[keys.PARAMETERS]
    assert (spec.space.low == -1.0).all() and (spec.space.high == 1.0).all()


def test_scaled_observations_stay_small_even_after_much_refuelling():
    env = ReleasedBoatDockEnv(300, observation="scaled")
    td = env.reset()
    for key in range(3):
        assert (td[keys.OBSERVATION].abs() <= 2.2).all()
        td = press(env, key, -0.95)
    for _ in range(900):
        td = press(env, 0, IDLE)
    fuel = td[keys.OBSERVATION][:, FUEL]
    assert (td[keys.OBSERVATION].abs() <= 6.0).all() and (fuel < 5.3).all()
    to_goal = td[keys.OBSERVATION][:, 2:4] - td[keys.OBSERVATION][:, X : Y + 1]
    torch.testing.assert_close(to_goal, td[keys.OBSERVATION][:, 15:])


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"start": (640.0, 512.0)}, "goal has shape None"),
        ({"start": (640.0, 512.0), "goal": (717.0, 512.0)}, "a goal lies outside"),
        ({"start": (640.0, 512.0), "goal": (640.0, 512.0)}, "within 1 px"),
        ({"start": (640.0, 512.0), "goal": (600.0, 512.0), "keymap": 1}, "the congruent controller has none"),
    ],
)
def test_an_invalid_layout_is_refused(given, complaint):
    with pytest.raises(ValueError, match=complaint):
        one().reset(TensorDict({name: torch.tensor([value]) for name, value in given.items()}, [1]))


def test_results_are_the_outcomes_without_a_score_of_their_own():
    env = ReleasedBoatDockEnv(5)
    outcome = torch.tensor([SUCCESS, WALL, WALL, OUT_OF_FUEL, TIME_LIMIT])
    results = env.results(TensorDict({keys.OUTCOME: outcome}, [5]))
    assert "score" not in results and results["success"].tolist() == [True, *[False] * 4]
    means = env.measure({name: value.numpy() for name, value in results.items()})
    assert means == pytest.approx({"wall": 0.4, "out_of_fuel": 0.2, "time_limit": 0.2})


def test_no_human_references_and_no_ceiling_are_shown_beside_it():
    env = ReleasedBoatDockEnv(5)
    measured = env.measure({"outcome": np.array([SUCCESS, WALL])})
    assert env.references(measured) == {}
