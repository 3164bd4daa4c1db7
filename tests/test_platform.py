"""PlatformEnv plays like the Platform domain and keeps the framework's contract."""

from __future__ import annotations

import pytest
import torch
from platform_players import COURSE, act, action, place, play, random_action, random_columns, rule

from hpamdp import keys
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.env.platform.rules import FELL, HOP, LEAP, MET_ENEMY, RUN, TIME_LIMIT
from hpamdp.specs import PAMDPSpecs


def test_learners_see_three_discrete_actions_of_one_parameter_each_and_no_options():
    env = PlatformEnv(2)
    specs = PAMDPSpecs.from_env(env)
    assert specs == PAMDPSpecs(
        9, (), (1, 1, 1), (0.0, 0.0, 0.0), (30.0, 720.0, 430.0), specs.initial_weight, specs.initial_bias
    )
    assert env.discrete_names == ("run", "hop", "leap")
    assert not env.has_choice


def test_learners_conventionally_start_with_run_3_hop_10_leap_400():
    specs = PAMDPSpecs.from_env(PlatformEnv(1))
    assert specs.initial_weight is not None and not torch.tensor(specs.initial_weight).any()
    torch.testing.assert_close(specs.from_unit(torch.tensor(specs.initial_bias)), torch.tensor([3.0, 10.0, 400.0]))


def test_a_hand_written_policy_arrives_with_a_return_of_one():
    env = PlatformEnv(500, seed=3)
    last, total = play(env, rule)
    success = env.results(last.select(*env.result_keys))["success"]
    assert success.float().mean() > 0.95
    torch.testing.assert_close(total[success], torch.ones_like(total[success]))
    assert last[keys.TERMINATED].all()


def test_random_actions_cover_less_than_a_sixth_of_the_course():
    env = PlatformEnv(2000)
    generator = torch.Generator().manual_seed(0)
    last, total = play(env, lambda _: random_action(env, generator))
    assert last[keys.DONE].all()
    assert total.mean().item() == pytest.approx(0.154, abs=0.01)  # gym-platform: .154, standard error .002
    torch.testing.assert_close(total, env.env_state()["x"] / COURSE)  # the rewards sum to the distance covered


def test_a_jump_that_is_too_short_falls():
    env = PlatformEnv(2)
    place(env, x=240.0, speed=0.0, enemy_x=50.0)
    reading = act(env, [HOP, LEAP], [720.0, 430.0])  # from standing
    assert reading[keys.OUTCOME].tolist() == [FELL, FELL]
    assert reading[keys.TERMINATED].all() and not reading[keys.TRUNCATED].any()
    assert (env.env_state()["x"] < 455.0).all()
    assert (reading[keys.REWARD] > 0.0).all()


def test_an_agent_that_waits_meets_the_enemy():
    env = PlatformEnv(4)
    last, total = play(env, lambda _: action([RUN] * 4, [0.0] * 4), 9)
    assert last[keys.OUTCOME].tolist() == [MET_ENEMY] * 4
    assert last[keys.TERMINATED].all()
    assert (total == 0.0).all()
    assert not env.results(last)["success"].any()


def test_the_step_limit_truncates_but_an_end_in_the_last_step_terminates():
    env = PlatformEnv(2, max_steps=2)
    env.reset()
    assert not act(env, [RUN, RUN], [0.0, 0.0])[keys.DONE].any()
    place(env, x=torch.tensor([0.0, 249.0]), speed=torch.tensor([0.0, 70.0]), enemy_x=100.0)
    reading = act(env, [RUN, RUN], [0.0, 30.0])
    assert reading[keys.TRUNCATED].squeeze(-1).tolist() == [True, False]
    assert reading[keys.TERMINATED].squeeze(-1).tolist() == [False, True]
    assert reading[keys.OUTCOME].tolist() == [TIME_LIMIT, FELL]


def test_observations_lie_in_their_range_and_encode_the_state():
    env = PlatformEnv(300)
    generator = torch.Generator().manual_seed(0)
    place(env, **random_columns(300, generator))
    columns = env.env_state()
    # A step that is masked in every row returns the state as it is.
    still = env._step(random_action(env, generator).set("_step", torch.zeros(300, dtype=torch.bool)))
    observation = still[keys.OBSERVATION]
    assert (observation.abs() <= 1.0 + 1e-6).all()
    unit = (observation + 1.0) / 2.0
    torch.testing.assert_close(unit[:, 0] * 1055.0 - 20.0, columns["x"], rtol=0.0, atol=1e-3)
    torch.testing.assert_close(unit[:, 1] * 100.0, columns["speed"], rtol=0.0, atol=1e-3)
    torch.testing.assert_close(unit[:, 2] * 1035.0, columns["enemy_x"], rtol=0.0, atol=1e-3)
    torch.testing.assert_close(unit[:, 3] * 60.0 - 30.0, columns["enemy_speed"], rtol=0.0, atol=1e-3)
    here = (columns["x"] >= 475.0).long() + (columns["x"] >= 985.0)
    course = torch.tensor(
        [[250.0, 275.0, 225.0, 0.0, 0.0], [275.0, 50.0, 235.0, 475.0, 0.0], [50.0, 0.0, 0.0, 985.0, 0.0]]
    )
    scale = torch.tensor([275.0, 275.0, 235.0, 1035.0, 1.0])
    torch.testing.assert_close(unit[:, 4:] * scale, course[here], rtol=0.0, atol=1e-3)


def test_without_noise_the_seed_makes_no_difference():
    readings = [play(PlatformEnv(2, noise=0.0, seed=seed), rule, 4)[0] for seed in (0, 1)]
    assert (readings[0] == readings[1]).all()


def test_episodes_stay_valid_with_a_hundred_times_the_noise():
    env = PlatformEnv(200, noise=100.0)
    generator = torch.Generator().manual_seed(0)
    last, total = play(env, lambda _: random_action(env, generator), 200)
    assert last[keys.OBSERVATION].isfinite().all()
    assert ((total >= 0.0) & (total <= 1.0)).all()
