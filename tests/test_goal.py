"""GoalEnv and HardGoalEnv play Robot Soccer Goal and keep the framework's contract."""

from __future__ import annotations

import math

import pytest
import torch
from batched_players import action, agrees, is_unchanged, play, random_player, snapshot
from conftest import make_config
from goal_players import act, place, trained_player
from tensor_rules import goal
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.env import counter_rng
from hpamdp.env.goal import rules
from hpamdp.env.goal.environment import GoalEnv, HardGoalEnv
from hpamdp.specs import PAMDPSpecs

NAN = math.nan


@pytest.mark.parametrize("domain", [GoalEnv, HardGoalEnv])
def test_all_tensors_are_as_the_specs_say(domain):
    check_env_specs(domain(3), return_contiguous=True)


def test_learners_see_kicks_and_shots_in_metres_in_goal_and_scaled_in_hard_goal():
    specs = PAMDPSpecs.from_env(GoalEnv(2))
    assert (specs.observation_dim, specs.parameter_dims) == (17, (2, 1, 1))
    assert specs.parameter_low == pytest.approx((0.0, -15.0, -7.01, -7.01))
    assert specs.parameter_high == pytest.approx((40.0, 15.0, 7.01, 7.01))
    hard = PAMDPSpecs.from_env(HardGoalEnv(2))
    assert (hard.observation_dim, hard.parameter_dims) == (17, (2, *(1,) * 10))
    assert (hard.parameter_low, hard.parameter_high) == ((-1.0,) * 12, (1.0,) * 12)
    assert len(HardGoalEnv.discrete_names) == 11


@pytest.mark.parametrize(
    ("domain", "expected_return", "most_goals"), [(GoalEnv, -8.11, 0.002), (HardGoalEnv, -7.47, 0.001)]
)
def test_random_play_scores_what_it_scores_by_the_published_code(domain, expected_return, most_goals):
    env = domain(6000, seed=1)
    last, total = play(env, random_player())
    results = env.results(last.select(*env.result_keys))
    assert agrees(total, expected_return, 0.005)
    assert results["success"].float().mean() <= most_goals
    assert last[keys.TERMINATED].all()
    if domain is GoalEnv:
        assert env.env_state()["steps"].float().mean().item() == pytest.approx(1.04, abs=0.02)


@pytest.mark.slow
def test_the_published_initial_parameters_find_twenty_times_more_goals():
    env = GoalEnv(20_000, seed=2)
    player = trained_player(env)
    reading = env.reset()
    while not reading[keys.DONE].all():
        reading = env.step(player(reading))["next"]
    assert agrees((reading[keys.OUTCOME] == rules.GOAL).float(), 0.008, 0.0005)


def test_initial_parameters_kick_the_ball_on_and_shoot_a_metre_inside_the_posts():
    env = GoalEnv(50, seed=3)
    raw_env = GoalEnv(50, seed=3, observation="raw")
    scaled, raw = env.reset()[keys.OBSERVATION], raw_env.reset()[keys.OBSERVATION]
    weights, bias = env.initial_parameters()
    parameters = PAMDPSpecs.from_env(env).from_unit(scaled @ weights.T + bias)
    ball_x, ball_y, unit_x, unit_y = (raw[:, rules.OBSERVATION_NAMES.index(name)] for name in (
        "ball_x", "ball_y", "keeper_to_ball_x", "keeper_to_ball_y"
    ))  # fmt: skip
    expected = [2.5 + ball_x + 1.25 * unit_x, 5.0 / 6.0 * ball_y + 5.0 / 3.0 * unit_y]
    expected += [torch.full((50,), 6.01), torch.full((50,), -6.01)]
    torch.testing.assert_close(parameters, torch.stack(expected, -1), rtol=0.0, atol=1e-4)
    weights, bias = raw_env.initial_parameters()
    from_raw = PAMDPSpecs.from_env(env).from_unit(raw @ weights.T + bias)
    torch.testing.assert_close(from_raw, parameters, rtol=0.0, atol=1e-4)
    assert HardGoalEnv().initial_parameters() is None


def test_a_goal_pays_fifty_and_every_other_end_costs_the_balls_distance():
    env = GoalEnv(3, noise=0.0)
    env.reset()
    # Before the open goal; with the keeper in the way; a ball that rolls off behind the player.
    place(env, ball_x=torch.tensor([18.0, 15.0, 1.0]), ball_y=0.0, ball_vx=torch.tensor([0.0, 0.0, -2.7]))
    place(env, player_x=torch.tensor([17.0, 14.0, 10.0]), player_y=0.0, player_angle=0.0)
    place(env, keeper_x=torch.tensor([2.0, 16.5, 2.0]), keeper_y=torch.tensor([12.0, 1.0, 12.0]))
    reading = act(env, [1, 1, 1], [[0.0], [0.0], [0.0]])
    assert reading[keys.OUTCOME].tolist() == [rules.GOAL, rules.CAUGHT, rules.OUT]
    state = env.state
    costs = (-goal.goal_distance(state)).tolist()
    assert reading[keys.REWARD].squeeze(-1).tolist() == [50.0, costs[1], costs[2]]
    assert reading[keys.TERMINATED].all() and not reading[keys.TRUNCATED].any()
    results = env.results(reading.select(*env.result_keys))
    assert results["success"].tolist() == [True, False, False] and results["score"].tolist() == [1.0, 0.0, 0.0]
    shares = env.measure({name: value.numpy() for name, value in results.items()})
    assert shares == pytest.approx({"caught": 1 / 3, "out": 1 / 3, "time_limit": 0.0})


def test_the_last_action_is_not_played_and_truncates():
    env = GoalEnv(2, max_steps=3)
    env.reset()
    place(env, steps=torch.tensor([1, 2]))
    before = snapshot(env)
    reading = act(env, [0, 0], [[3.0, 0.0], [3.0, 0.0]])
    assert reading[keys.TRUNCATED].squeeze(-1).tolist() == [False, True]
    assert not reading[keys.TERMINATED].any()
    assert reading[keys.OUTCOME].tolist()[1] == rules.TIME_LIMIT
    assert all(torch.equal(env.env_state()[name][1], before[name][1]) for name in rules.COLUMNS)
    assert (env.state.ball_x != before["ball_x"]).tolist() == [True, False]
    assert reading[keys.REWARD][1].item() == -goal.goal_distance(env.state)[1].item()
    # After it, the episode stays as it is and earns nothing.
    over = snapshot(env)
    reading = act(env, [1, 1], [[0.0], [0.0]])
    assert is_unchanged(env, over, torch.tensor([False, True]))
    assert reading[keys.DONE][1] and reading[keys.REWARD][1].item() == 0.0


def test_without_noise_the_same_start_has_one_future():
    envs = [GoalEnv(20, noise=0.0, seed=seed) for seed in (0, 1)]
    for env in envs:
        env.reset()
    place(envs[1], **{name: envs[0].env_state()[name] for name in rules.COLUMNS})
    readings = [act(env, [0] * 20, [[4.0, 0.0]] * 20) for env in envs]
    assert (readings[0] == readings[1]).all()


def test_numbers_of_an_episode_are_never_drawn_twice():
    one = torch.tensor([12345], dtype=torch.int32)
    rng = counter_rng.rng_key(one[0], counter_rng.NOISE, one, one)
    ticks = torch.arange(400, dtype=torch.int32)
    drawn = [goal.random_numbers(rng, torch.tensor([steps], dtype=torch.int32), ticks) for steps in range(100)]
    numbers = torch.stack(drawn).flatten()
    assert numbers.unique().numel() > 0.985 * numbers.numel()  # of 2^23 values, 240,000 rarely meet by chance
    assert numbers.abs().max() < 1.0
    assert numbers.mean().abs() < 0.01


def test_only_the_parameters_of_the_chosen_action_count_and_are_clipped():
    given_env, inside = GoalEnv(3), GoalEnv(3)
    given_env.reset()
    inside.reset()
    outside = torch.tensor([[99.0, -99.0, NAN, NAN], [NAN, NAN, 99.0, NAN], [NAN, NAN, NAN, -99.0]])
    readings = [
        given_env.step(action(torch.tensor([0, 1, 2]), outside))["next"],
        act(inside, [0, 1, 2], [[40.0, -15.0], [7.01], [-7.01]]),
    ]
    torch.testing.assert_close(readings[0][keys.OBSERVATION], readings[1][keys.OBSERVATION])


def test_a_repair_of_the_middle_shots_is_refused_on_goal_in_one_line_and_made_on_hard_goal():
    words = ["high=none", "low=pdqn", "env.repaired=[middle_shots]"]
    with pytest.raises(ConfigError, match=r'^env\.repaired\.0="middle_shots": must be .* \(GoalEnv\)$'):
        make_config(["env=goal", *words])
    assert make_config(["env=hard_goal", *words]).env.build(num_envs=2).options.repaired == ("middle_shots",)


def test_repairs_change_what_is_done_and_seen():
    plain, repaired = (HardGoalEnv(200, repaired=slips) for slips in ((), HardGoalEnv.slips))
    for env in (plain, repaired):
        env.reset()
        place(env, keeper_y=-14.0, keeper_x=12.0, ball_y=-13.0, ball_x=11.0, player_y=-13.0, player_x=10.0)
    still = action(torch.zeros(200, dtype=torch.long), torch.zeros(200, 12)).set("_step", torch.zeros(200).bool())
    seen = [env._step(still.clone())[keys.OBSERVATION] for env in (plain, repaired)]
    assert torch.equal(seen[0][:, :16], seen[1][:, :16])
    kicks = [act(env, [0] * 200, [[-0.5, -0.5]] * 200)[keys.OBSERVATION] for env in (plain, repaired)]
    ball_y = rules.OBSERVATION_NAMES.index("ball_y")
    assert (kicks[0][:, ball_y] > kicks[1][:, ball_y]).float().mean() > 0.9
