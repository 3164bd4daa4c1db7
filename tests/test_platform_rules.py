"""Actions in PlatformEnv follow the published rules, which a study writes down for one agent, tick by tick."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import pytest
import torch
from platform_players import COURSE, act, action, place, random_action, random_columns, rule
from scripts import load_script
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.env.platform.rules import ARRIVED, FELL, LEAP, MET_ENEMY, ON_THE_WAY

NUMBERS = 512  # random numbers of each action
REPLAY = Path(__file__).resolve().parent.parent / "experiments" / "domains" / "replay.py"


@pytest.fixture(scope="module")
def scalar_course():
    """Return the published rules for one agent, which the study compares with recordings of the published code."""
    load_script(REPLAY)  # it finds the adapters
    return importlib.import_module("adapters.platform").ScalarCourse


def numbers_of_next_action(env: PlatformEnv, seed: int) -> list[list[float]]:
    """Return the random numbers of every environment's next action, `[N, NUMBERS]`."""
    state = env.env_state()
    environment = torch.arange(env.num_envs, dtype=torch.int32)
    rng = counter_rng.rng_key(counter_rng.seed_tensor(seed), counter_rng.NOISE, environment, state["episode"])
    index = (state["steps"] * NUMBERS).unsqueeze(-1) + torch.arange(NUMBERS, dtype=torch.int32)
    return counter_rng.normal(rng._replace(bits=rng.bits.unsqueeze(-1)), index).tolist()


def compare(
    env: PlatformEnv, courses: list[Any], actions: TensorDict, seed: int, noise: float
) -> tuple[Tensor, list[int]]:
    """Take one action in the environments and by the published rules, and compare the results where no episode is over.

    Return the observation and the outcomes of the compared environments.
    """
    over = env.env_state()["outcome"] != ON_THE_WAY
    numbers = numbers_of_next_action(env, seed)
    reading = env.step(actions.clone())["next"]
    discrete = actions[keys.DISCRETE].tolist()
    parameter = actions[keys.PARAMETERS].tolist()
    rewards = reading[keys.REWARD].squeeze(-1).tolist()
    got_outcomes = reading[keys.OUTCOME].tolist()
    names = ("x", "speed", "enemy_x", "enemy_speed")
    state = list(zip(*(env.env_state()[name].tolist() for name in names), strict=True))
    outcomes = []
    for i in (~over).nonzero().squeeze(-1).tolist():
        course = courses[i]
        reward, outcome = course.act(discrete[i], parameter[i][discrete[i]], [noise * number for number in numbers[i]])
        expected = (course.x, course.speed, *course.enemy, COURSE * reward)
        assert (*state[i], COURSE * rewards[i]) == pytest.approx(expected, abs=0.01), (
            f"environment {i}, discrete {discrete[i]}"
        )
        assert got_outcomes[i] == outcome
        outcomes.append(outcome)
    return reading[keys.OBSERVATION], outcomes


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_actions_from_anywhere_follow_the_published_rules(noise, scalar_course):
    num = 500
    seed = 5
    generator = torch.Generator().manual_seed(1)
    env = PlatformEnv(num, noise=noise, seed=seed)
    place(env, **random_columns(num, generator))
    state = env.env_state()
    columns = (state[name].tolist() for name in ("x", "speed", "enemy_x", "enemy_speed"))
    courses = [scalar_course(*column) for column in zip(*columns, strict=True)]
    outcomes = []
    for _ in range(3):
        outcomes += compare(env, courses, random_action(env, generator), seed, noise)[1]
    assert min(outcomes.count(outcome) for outcome in (ON_THE_WAY, ARRIVED, FELL, MET_ENEMY)) > 50


def test_episodes_from_start_to_end_follow_the_published_rules(scalar_course):
    num = 100
    seed = 2**40 + 7
    generator = torch.Generator().manual_seed(2)
    env = PlatformEnv(num, seed=seed)
    observation = env.reset()[keys.OBSERVATION]
    courses = [scalar_course(0.0, 0.0, 230.0, -30.0) for _ in range(num)]
    ends = []
    for _ in range(12):
        careless = torch.rand(num, 1, generator=generator) < 0.1
        by_rule = rule(observation)
        by_chance = random_action(env, generator)
        discrete = torch.where(careless.squeeze(-1), by_chance[keys.DISCRETE], by_rule[keys.DISCRETE])
        parameter = torch.where(careless, by_chance[keys.PARAMETERS], by_rule[keys.PARAMETERS])
        observation, outcomes = compare(env, courses, action(discrete, parameter), seed, 1.0)
        ends += [outcome for outcome in outcomes if outcome != ON_THE_WAY]
    assert min(ends.count(outcome) for outcome in (ARRIVED, FELL, MET_ENEMY)) > 10
    assert len(ends) == num


@pytest.mark.parametrize(("edge", "inwards"), [(250.0, -1.0), (455.0, 1.0)])
def test_an_agent_that_comes_down_at_an_edge_is_pushed_out_on_the_shorter_way(edge, inwards):
    env = PlatformEnv(3, noise=0.0)
    place(env, x=200.0, speed=70.0, enemy_x=0.0)
    act(env, [LEAP] * 3, [430.0] * 3)
    flight = env.env_state()["x"] - 200.0  # it ends in the gap, 1.2 px below the top
    aims = edge + inwards * torch.tensor([-0.5, 0.6, 1.8])
    env.reset()
    place(env, x=aims - flight, speed=70.0, enemy_x=0.0)
    reading = act(env, [LEAP] * 3, [430.0] * 3)
    assert reading[keys.OUTCOME].tolist() == [FELL, FELL, ON_THE_WAY]
    torch.testing.assert_close(env.env_state()["x"], torch.stack([aims[0], torch.tensor(edge), aims[2]]))
