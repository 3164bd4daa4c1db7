"""ReleasedBoatDockEnv keeps the framework's contract: specs, batches, seeds, saved states, invalid inputs, results."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
import torch
from released_players import (
    FUEL,
    IDLE,
    STEP,
    X,
    Y,
    action,
    layouts,
    one,
    place,
    press,
    restart,
)
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.env.boatdock_released.environment import ReleasedBoatDockEnv
from hpamdp.env.boatdock_released.rules import OUT_OF_FUEL, SUCCESS, TIME_LIMIT, WALL


@pytest.mark.parametrize("observation", ["pixels", "scaled"])
@pytest.mark.parametrize("controller", ["congruent", "incongruent"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_all_tensors_are_as_the_specs_say(controller, observation, dtype):
    check_env_specs(ReleasedBoatDockEnv(5, controller=controller, observation=observation, dtype=dtype))


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


@pytest.mark.parametrize("frozen", [True, False])
def test_episodes_do_not_depend_on_the_number_of_environments(frozen):
    generator = torch.Generator().manual_seed(0)
    few = ReleasedBoatDockEnv(2, controller="incongruent", frozen_layouts=frozen, seed=3)
    many = ReleasedBoatDockEnv(9, controller="incongruent", frozen_layouts=frozen, seed=3)
    readings = [few.reset(), many.reset()]
    for step in range(60):
        actions = action(
            torch.randint(3, (9,), generator=generator), -1.0 + 0.15 * torch.rand(9, 3, generator=generator)
        )
        readings = [few.step(actions[:2].clone())["next"], many.step(actions.clone())["next"]]
        assert (readings[0] == readings[1][:2]).all()
        if step % 5 == 0:
            readings = [
                restart(few, readings[0], [True, False]),
                restart(many, readings[1], [True, False, *[True] * 7]),
            ]
            assert (readings[0] == readings[1][:2]).all()


@pytest.mark.parametrize("seed", [0, 2**63 + 5])
def test_a_seed_fixes_everything_and_global_generators_are_neither_moved_nor_read(seed):
    def states() -> tuple:
        return torch.get_rng_state().tolist(), str(np.random.get_state()), random.getstate()

    env = ReleasedBoatDockEnv(30, controller="incongruent", seed=1)
    before = states()
    env.set_seed(seed)
    first = [env.reset(), press(env, 0, -0.95), env.reset()]
    assert states() == before
    torch.rand(3)
    env.set_seed(seed)
    again = [env.reset(), press(env, 0, -0.95), env.reset()]
    assert all((one == other).all() for one, other in zip(first, again, strict=True))
    env.set_seed(seed + 1)
    assert (layouts(env.reset()) != layouts(first[0])).any(-1).all()


def test_a_finished_episode_stays_as_it_is_and_earns_nothing():
    env = one()
    place(env, (640.0, 512.0), (640.0, 440.0))
    last = press(env, 1, STEP)
    after = press(env, 0, -0.95)
    assert after[keys.DONE].item() and after[keys.REWARD].item() == 0.0
    assert (after[keys.OBSERVATION] == last[keys.OBSERVATION]).all()


def test_a_restored_state_continues_as_the_original():
    env, copy = (ReleasedBoatDockEnv(6, controller="incongruent", frozen_layouts=False, seed=2) for _ in range(2))
    env.reset()
    press(env, 1, -0.95)
    copy.set_env_state({name: column.clone() for name, column in env.env_state().items()})
    for step in (lambda e: press(e, 2, -0.97), lambda e: e.reset(), lambda e: press(e, 0, -0.93)):
        assert (step(env) == step(copy)).all()
    for columns, complaint in (
        (ReleasedBoatDockEnv(2).env_state(), r"\[2\], but must be \[6\]"),
        ({"x": 0}, "not x"),
    ):
        with pytest.raises(ValueError, match=complaint):
            env.set_env_state(columns)


@pytest.mark.parametrize(
    ("bad", "complaint"),
    [
        (action([0, 3], [0.0, 0.0]), r"environment 1 got key=3 \(allowed 0 to 2\)"),
        (action([0, 1], [0.0, math.nan]), "environment 1 got key=1 .*nan"),
        (action([[0], [1]], torch.zeros(2, 3)), "shape"),
        (action([0.5, 1.0], [0.0, 0.0]), "must be integer"),
    ],
)
def test_an_invalid_action_is_refused_and_changes_nothing(bad, complaint):
    env = ReleasedBoatDockEnv(2)
    env.reset()
    before = env.env_state()
    with pytest.raises(ValueError, match=complaint):
        env.step(bad)
    assert all(torch.equal(now, before[name]) for name, now in env.env_state().items())


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


@pytest.mark.parametrize(
    "arguments",
    [{"num_envs": 0}, {"max_steps": 0}, {"controller": "choose"}, {"keymap": 2}, {"test_mode": 3}, {"dtype": "int"}],
    ids=str,
)
def test_an_invalid_argument_is_refused_by_name(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        ReleasedBoatDockEnv(**arguments)


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
