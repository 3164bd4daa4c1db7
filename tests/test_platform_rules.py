"""Actions in PlatformEnv follow the published rules, which are written down here for one agent, tick by tick."""

from __future__ import annotations

import pytest
import torch
from platform_players import COURSE, act, action, place, random_action, random_columns, rule
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.env.platform.rules import ARRIVED, FELL, HOP, LEAP, MET_ENEMY, ON_THE_WAY, RUN

NUMBERS = 512  # random numbers of each action


class ScalarCourse:
    """The published rules for one agent, tick by tick and in double precision."""

    PLATFORMS = ((0.0, 250.0), (475.0, 750.0), (985.0, 1035.0))
    TOP, WIDTH, HEIGHT, TICK = 40.0, 20.0, 30.0, 0.05

    def __init__(self, x: float, speed: float, enemy_x: float, enemy_speed: float) -> None:
        self.x = x
        self.y = self.TOP
        self.speed = speed
        self.rise = 0.0
        self.enemies = [[230.0, -30.0], [730.0, -30.0]]
        self.enemies[x > 475.0] = [enemy_x, enemy_speed]

    @property
    def enemy(self) -> list[float]:
        return self.enemies[self.x > 475.0]

    def stands(self) -> bool:
        return self.y == self.TOP and any(left - self.WIDTH <= self.x <= right for left, right in self.PLATFORMS)

    def act(self, discrete: int, parameter: float, numbers: list[float]) -> tuple[float, int]:
        """Return reward and outcome.

        `numbers` are normal: two for a jump, then one for the agent and one for the enemy each tick.
        """
        start = self.x
        tick = 0
        time_left = 1.0
        while True:
            self._choose(discrete, parameter, numbers, tick)
            self._patrol(numbers[3 + 2 * tick])
            self._move()
            outcome = self._outcome()
            tick = tick + 1
            time_left = time_left - self.TICK
            if outcome != ON_THE_WAY or (time_left <= 0.0 if discrete == RUN else self.stands()):
                return (self.x - start) / COURSE, outcome

    def _choose(self, discrete: int, parameter: float, numbers: list[float], tick: int) -> None:
        on_ground = self.stands()
        across, up = 0.0, -9.8
        if on_ground and discrete == RUN:
            across = parameter / self.TICK
            up = 0.0
        elif on_ground:
            rise = 35.0 if discrete == HOP else 25.0
            change = min(max(parameter / (2.0 * rise / 9.8 + 1.0) - self.speed, -600.0), 200.0 - rise)
            across = (change - abs(numbers[0])) / self.TICK
            up = (rise - abs(numbers[1])) / self.TICK
        self.speed += min(max(across, -600.0), 600.0) * self.TICK - abs(0.025 * numbers[2 + 2 * tick])
        self.speed = min(max(self.speed, 0.0), 70.0 if on_ground else 100.0)
        self.rise = min(max(self.rise + min(max(up, -4000.0), 4000.0) * self.TICK, -200.0), 200.0)

    def _patrol(self, number: float) -> None:
        enemy = self.enemy
        left = self.PLATFORMS[self.x > 475.0][0]
        right = self.PLATFORMS[self.x > 475.0][1] - self.WIDTH
        if not left < enemy[0] < right:
            enemy[1] = -enemy[1]
        enemy[1] = min(max(enemy[1] + 0.025 * number, -30.0), 30.0)
        enemy[0] = min(max(enemy[0] + enemy[1] * self.TICK, left), right)

    def _move(self) -> None:
        self.x = min(max(self.x + self.speed * self.TICK, 0.0), COURSE)
        self.y += self.rise * self.TICK
        self.speed *= 0.99
        for left, right in self.PLATFORMS:
            if left - self.WIDTH < self.x < right and -self.HEIGHT < self.y < self.TOP:
                self.speed = 0.0
                aside = left - self.WIDTH if self.x < left else right if self.x > right - self.WIDTH else None
                if aside is not None and abs(self.x - aside) < self.TOP - self.y:
                    self.x = aside
                else:
                    self.y = self.TOP
                    self.rise = 0.0

    def _outcome(self) -> int:
        if self.x >= COURSE:
            return ARRIVED
        if any(abs(self.x - x) < self.WIDTH and abs(self.y - self.TOP) < self.HEIGHT for x, _ in self.enemies):
            return MET_ENEMY
        return FELL if self.y < self.TOP else ON_THE_WAY


def numbers_of_next_action(env: PlatformEnv, seed: int) -> list[list[float]]:
    """Return the random numbers of every environment's next action, `[N, NUMBERS]`."""
    state = env.env_state()
    environment = torch.arange(env.num_envs, dtype=torch.int32)
    rng = counter_rng.rng_key(counter_rng.seed_tensor(seed), counter_rng.NOISE, environment, state["episode"])
    index = (state["steps"] * NUMBERS).unsqueeze(-1) + torch.arange(NUMBERS, dtype=torch.int32)
    return counter_rng.normal(rng._replace(bits=rng.bits.unsqueeze(-1)), index).tolist()


def compare(
    env: PlatformEnv, courses: list[ScalarCourse], actions: TensorDict, seed: int, noise: float
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
def test_actions_from_anywhere_follow_the_published_rules(noise):
    num = 500
    seed = 5
    generator = torch.Generator().manual_seed(1)
    env = PlatformEnv(num, noise=noise, seed=seed)
    place(env, **random_columns(num, generator))
    state = env.env_state()
    columns = (state[name].tolist() for name in ("x", "speed", "enemy_x", "enemy_speed"))
    courses = [ScalarCourse(*column) for column in zip(*columns, strict=True)]
    outcomes = []
    for _ in range(3):
        outcomes += compare(env, courses, random_action(env, generator), seed, noise)[1]
    assert min(outcomes.count(outcome) for outcome in (ON_THE_WAY, ARRIVED, FELL, MET_ENEMY)) > 50


def test_episodes_from_start_to_end_follow_the_published_rules():
    num = 100
    seed = 2**40 + 7
    generator = torch.Generator().manual_seed(2)
    env = PlatformEnv(num, seed=seed)
    observation = env.reset()[keys.OBSERVATION]
    courses = [ScalarCourse(0.0, 0.0, 230.0, -30.0) for _ in range(num)]
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
