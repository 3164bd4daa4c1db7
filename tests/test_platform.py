"""PlatformEnv plays like the Platform domain and keeps the framework's contract."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
import torch
from conftest import global_generators_unmoved
from platform_players import COURSE, act, action, place, play, random_action, random_columns, rule
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.env.platform.rules import FELL, HOP, LEAP, MET_ENEMY, ON_THE_WAY, RUN, TIME_LIMIT
from hpamdp.specs import PAMDPSpecs


def restart(env: PlatformEnv, reading: TensorDictBase, mask: Tensor) -> TensorDictBase:
    """Start new episodes in the rows of `mask` `[N]`."""
    return env.reset(reading.clone().set("_reset", mask.unsqueeze(-1)))


def snapshot(env: PlatformEnv) -> dict[str, Tensor]:
    return {name: column.clone() for name, column in env.env_state().items()}


def is_unchanged(env: PlatformEnv, before: dict[str, Tensor], rows=slice(None)) -> bool:
    return all(torch.equal(now[rows], before[name][rows]) for name, now in env.env_state().items())


@pytest.mark.parametrize("num", [1, 3])
def test_all_tensors_are_as_the_specs_say(num):
    check_env_specs(PlatformEnv(num), return_contiguous=True)


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


def test_only_the_parameter_of_the_chosen_action_counts_and_is_clipped():
    given, inside = PlatformEnv(4), PlatformEnv(4)
    nan = math.nan
    discrete = [RUN, HOP, LEAP, RUN]
    outside = torch.tensor([[1e9, nan, nan], [nan, 1e9, nan], [nan, nan, 1e9], [-5.0, nan, nan]])
    given.reset()
    inside.reset()
    readings = act(given, discrete, outside), act(inside, discrete, [30.0, 720.0, 430.0, 0.0])
    assert (readings[0] == readings[1]).all()


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


def test_the_episodes_of_an_environment_do_not_depend_on_the_others():
    few, many = PlatformEnv(3, seed=11), PlatformEnv(8, seed=11)
    readings = few.reset(), many.reset()
    for _ in range(6):
        actions = rule(readings[1][keys.OBSERVATION])
        actions[keys.DISCRETE][3:] = RUN
        readings = few.step(actions[:3].clone())["next"], many.step(actions.clone())["next"]
        assert (readings[0] == readings[1][:3]).all()
        # Start new episodes only in some of the others.
        restart(many, readings[1], torch.arange(8) > 4)


@pytest.mark.parametrize("seed", [0, 2**31, 2**63 + 5])
def test_a_seed_fixes_the_noise(seed):
    env, other = PlatformEnv(20, seed=1), PlatformEnv(20, seed=seed + 1)
    env.set_seed(seed)
    assert env.fixed_episodes(seed) is None
    first, _ = play(env, rule, 3)
    second, _ = play(env, rule, 3)
    env.set_seed(seed)
    again, _ = play(env, rule, 3)
    different, _ = play(other, rule, 3)
    assert (first == again).all()
    for later in (second, different):
        assert (first[keys.OBSERVATION] != later[keys.OBSERVATION]).any(-1).all()


def test_evaluation_has_other_noise_than_training_with_the_same_seed():
    env = PlatformEnv(20, seed=3)
    training, _ = play(env, rule, 3)
    env.seed_evaluation(3)
    evaluation, _ = play(env, rule, 3)
    env.seed_evaluation(3)
    again, _ = play(env, rule, 3)
    env.set_seed(3)
    assert (play(env, rule, 3)[0] == training).all()
    assert (again == evaluation).all()
    assert (training[keys.OBSERVATION] != evaluation[keys.OBSERVATION]).any(-1).all()


def test_without_noise_the_seed_makes_no_difference():
    readings = [play(PlatformEnv(2, noise=0.0, seed=seed), rule, 4)[0] for seed in (0, 1)]
    assert (readings[0] == readings[1]).all()


def test_episodes_stay_valid_with_a_hundred_times_the_noise():
    env = PlatformEnv(200, noise=100.0)
    generator = torch.Generator().manual_seed(0)
    last, total = play(env, lambda _: random_action(env, generator), 200)
    assert last[keys.OBSERVATION].isfinite().all()
    assert ((total >= 0.0) & (total <= 1.0)).all()


def test_global_generators_are_neither_moved_nor_read():
    env = PlatformEnv(8)

    def run() -> TensorDictBase:
        env.set_seed(5)
        env.reset()
        return act(env, [0, 1, 2, 0, 1, 2, 0, 1], [20.0] * 8)

    with global_generators_unmoved():
        once = run()
    torch.rand(3)
    np.random.rand()
    random.random()
    assert (run() == once).all()


def test_a_partial_reset_leaves_the_other_environments_alone():
    env = PlatformEnv(4)
    env.reset()
    reading = act(env, [RUN] * 4, [10.0] * 4)
    before = snapshot(env)
    mask = torch.tensor([False, True, False, True])
    fresh = restart(env, reading, mask)
    state = env.env_state()
    assert is_unchanged(env, before, ~mask)
    assert (fresh[keys.OBSERVATION] == reading[keys.OBSERVATION]).all(-1).tolist() == [True, False, True, False]
    assert state["episode"].tolist() == [0, 1, 0, 1]
    assert (state["x"] > 0.0).tolist() == [True, False, True, False]
    assert state["steps"].tolist() == [1, 0, 1, 0]


def test_a_finished_episode_stays_finished_and_earns_nothing():
    env = PlatformEnv(64)
    generator = torch.Generator().manual_seed(0)
    env.reset()
    env.step(random_action(env, generator))
    before = snapshot(env)
    over = before["outcome"] != ON_THE_WAY
    assert 0 < over.sum() < 64
    after = env.step(random_action(env, generator))["next"]
    assert is_unchanged(env, before, over)
    assert after[keys.DONE][over].all()
    assert (after[keys.REWARD][over] == 0.0).all()
    assert (env.env_state()["steps"][~over] == 2).all()


def test_returned_tensors_never_change_later():
    env = PlatformEnv(16)
    generator = torch.Generator().manual_seed(0)
    returned = [env.reset()]
    copies = [returned[0].clone()]
    columns = env.env_state()
    column_copies = snapshot(env)
    for _ in range(3):
        stepped = env.step(random_action(env, generator))["next"]
        for reading in (stepped, restart(env, stepped, torch.rand(16, generator=generator) < 0.5)):
            returned.append(reading)
            copies.append(reading.clone())
    assert all((now == then).all() for now, then in zip(returned, copies, strict=True))
    assert all(torch.equal(columns[name], column_copies[name]) for name in columns)


def test_a_restored_state_continues_as_the_original():
    env, copy = PlatformEnv(8, seed=2), PlatformEnv(8, seed=2)
    for _ in range(2):
        play(env, rule, 2)
    copy.set_env_state(snapshot(env))
    for discrete in (HOP, RUN, LEAP):
        results = [act(e, [discrete] * 8, [20.0] * 8) for e in (env, copy)]
        assert (results[0] == results[1]).all()


def test_a_state_of_other_environments_is_refused_and_an_empty_one_starts_new_episodes():
    env = PlatformEnv(3)
    play(env, rule, 2)
    before = snapshot(env)
    with pytest.raises(ValueError, match=r"x is \[2\], but must be \[3\]"):
        env.set_env_state(PlatformEnv(2).env_state())
    with pytest.raises(ValueError, match="not x, speed"):
        env.set_env_state({name: before[name] for name in ("x", "speed")})
    assert is_unchanged(env, before)
    env.set_env_state({})
    assert env.env_state()["steps"].tolist() == [0, 0, 0]
    assert env.env_state()["episode"].tolist() == [1, 1, 1]


BAD_ACTIONS = {
    "nan": action([RUN, HOP], [0.1, math.nan]),
    "inf": action([RUN, HOP], [math.inf, 0.1]),
    "discrete action too large": action([0, 3], [0.1, 0.1]),
    "discrete action negative": action([-1, 0], [0.1, 0.1]),
    "discrete action of another shape": action([[0], [1]], torch.zeros(2, 3)),
    "one parameter each": action([0, 1], [[0.1], [0.1]]),
    "fractional discrete action": action([0.5, 1.0], [0.1, 0.1]),
    "no discrete action": action([0, 1], [0.1, 0.1]).exclude(keys.DISCRETE),
}


@pytest.mark.parametrize("name", BAD_ACTIONS)
def test_an_invalid_action_is_refused_and_changes_nothing(name):
    env = PlatformEnv(2)
    env.reset()
    before = snapshot(env)
    with pytest.raises(ValueError, match="step: "):
        env.step(BAD_ACTIONS[name].clone())
    assert is_unchanged(env, before)


@pytest.mark.parametrize(
    "arguments", [{"num_envs": 0}, {"max_steps": 0}, {"noise": -0.1}, {"noise": math.nan}, {"noise": 1e30}], ids=str
)
def test_an_invalid_argument_is_refused_by_name(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        PlatformEnv(**arguments)


def test_float64_parameters_leave_rewards_and_observations_float32():
    env = PlatformEnv(2)
    env.reset()
    given = action([RUN, HOP], [5.0, 50.0])
    given[keys.PARAMETERS] = given[keys.PARAMETERS].double()
    following = env.step(given)["next"]
    assert following[keys.OBSERVATION].dtype == following[keys.REWARD].dtype == torch.float32
