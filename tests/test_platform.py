"""PlatformEnv follows the published rules and keeps the framework's contract."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import numpy as np
import pytest
import torch
from conftest import global_generators_unmoved
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.platform import ARRIVED, FELL, HOP, LEAP, MET_ENEMY, ON_THE_WAY, RUN, TIME_LIMIT, PlatformEnv
from hpamdp.specs import PAMDPSpecs

COURSE = 1035.0
BOUNDS = torch.tensor([30.0, 720.0, 430.0])
NUMBERS = 512  # random numbers that an action may take


class ScalarCourse:
    """The published rules for one agent, tick by tick and in double precision."""

    PLATFORMS = ((0.0, 250.0), (475.0, 750.0), (985.0, 1035.0))
    TOP, WIDTH, HEIGHT, TICK = 40.0, 20.0, 30.0, 0.05

    def __init__(self, x: float, speed: float, enemy_x: float, enemy_speed: float) -> None:
        self.x, self.y, self.speed, self.rise = x, self.TOP, speed, 0.0
        self.enemies = [[230.0, -30.0], [730.0, -30.0]]
        self.enemies[x > 475.0] = [enemy_x, enemy_speed]

    @property
    def enemy(self) -> list[float]:
        return self.enemies[self.x > 475.0]

    def stands(self) -> bool:
        return self.y == self.TOP and any(left - self.WIDTH <= self.x <= right for left, right in self.PLATFORMS)

    def act(self, key: int, parameter: float, numbers: list[float]) -> tuple[float, int]:
        """Return reward and outcome; `numbers` are normal: two for a jump, then the agent's and the enemy's a tick."""
        start, tick, time_left = self.x, 0, 1.0
        while True:
            self._choose(key, parameter, numbers, tick)
            self._patrol(numbers[3 + 2 * tick])
            self._move()
            outcome = self._outcome()
            tick, time_left = tick + 1, time_left - self.TICK
            if outcome != ON_THE_WAY or (time_left <= 0.0 if key == RUN else self.stands()):
                return (self.x - start) / COURSE, outcome

    def _choose(self, key: int, parameter: float, numbers: list[float], tick: int) -> None:
        on_ground = self.stands()
        across, up = 0.0, -9.8
        if on_ground and key == RUN:
            across, up = parameter / self.TICK, 0.0
        elif on_ground:
            rise = 35.0 if key == HOP else 25.0
            change = min(max(parameter / (2.0 * rise / 9.8 + 1.0) - self.speed, -600.0), 200.0 - rise)
            across, up = (change - abs(numbers[0])) / self.TICK, (rise - abs(numbers[1])) / self.TICK
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
                    self.y, self.rise = self.TOP, 0.0

    def _outcome(self) -> int:
        if self.x >= COURSE:
            return ARRIVED
        if any(abs(self.x - x) < self.WIDTH and abs(self.y - self.TOP) < self.HEIGHT for x, _ in self.enemies):
            return MET_ENEMY
        return FELL if self.y < self.TOP else ON_THE_WAY


def action(key, parameter) -> TensorDict:
    """Build an action of every environment: `key` a list or `[N]`, `parameter` one number each or `[N, 3]`."""
    key, parameter = torch.as_tensor(key), torch.as_tensor(parameter, dtype=torch.float32)
    parameter = parameter if parameter.ndim == 2 else parameter.unsqueeze(-1).expand(-1, 3)
    press = TensorDict(key=key, duration=parameter, batch_size=[len(key)])
    return TensorDict({keys.ACTION: press}, batch_size=[len(key)])


def act(env: PlatformEnv, key, parameter) -> TensorDictBase:
    return env.step(action(key, parameter))["next"]


def random_action(env: PlatformEnv, generator: torch.Generator) -> TensorDict:
    key = torch.randint(3, (env.num_envs,), generator=generator)
    return action(key, BOUNDS * torch.rand(env.num_envs, 3, generator=generator))


def rule(observation: Tensor) -> TensorDict:
    """Hop over each enemy, then run up to each gap and hop across it."""
    x, speed = (observation[:, 0] + 1.0) / 2.0 * (COURSE + 20.0) - 20.0, (observation[:, 1] + 1.0) / 2.0 * 100.0
    key, parameter = torch.full_like(x, RUN, dtype=torch.long), torch.full_like(x, 30.0)
    for case, pressed, value in (
        ((x >= 40.0) & (x < 150.0), HOP, 0.0),
        ((x >= 150.0) & (x <= 250.0), RUN, ((246.0 - x) / 10.0).clamp(min=0.0)),
        ((x >= 150.0) & (x <= 250.0) & (speed > 20.0), HOP, 720.0),
        ((x >= 455.0) & (x < 580.0), HOP, 720.0),
        ((x >= 640.0) & (x < 700.0), RUN, 0.0),
        ((x >= 700.0) & (x <= 750.0), HOP, 720.0),
    ):
        key, parameter = torch.where(case, pressed, key), torch.where(case, value, parameter)
    return action(key, parameter)


def play(env: PlatformEnv, policy: Callable[[Tensor], TensorDict], most: int = 50) -> tuple[TensorDictBase, Tensor]:
    """Play every environment's episode from a reset; return the last reading and the returns `[N]`."""
    td, total = env.reset(), torch.zeros(env.num_envs)
    for _ in range(most):
        td = env.step(policy(td[keys.OBSERVATION]))["next"]
        total = total + td[keys.REWARD].squeeze(-1)
    return td, total


def place(env: PlatformEnv, **columns: Tensor | float) -> None:
    """Put the agents and enemies elsewhere."""
    state = env.state_columns()
    given = {name: torch.as_tensor(value).expand(env.num_envs) for name, value in columns.items()}
    env.set_state_columns({**state, **given})


def random_columns(num: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Draw agents on the platforms and up to 4 px beyond, often near the right edge, and enemies, often at theirs."""

    def uniform(low, high) -> Tensor:
        return low + (high - low) * torch.rand(num, generator=generator)

    platform = torch.randint(3, (num,), generator=generator)
    left, right = torch.tensor([0.0, 455.0, 965.0])[platform], torch.tensor([254.0, 754.0, 1034.0])[platform]
    x = torch.where(uniform(0.0, 1.0) < 0.3, right - uniform(0.0, 45.0), uniform(left, right))
    enemy_left = torch.where(x > 475.0, 475.0, 0.0)
    enemy_right = torch.where(x > 475.0, 730.0, 230.0)
    enemy_x = uniform(enemy_left - 20.0, enemy_right + 20.0).clamp(enemy_left, enemy_right)
    steps, episode = (torch.randint(150, (num,), generator=generator, dtype=torch.int32) for _ in range(2))
    columns = {"x": x, "speed": uniform(0.0, 70.0), "enemy_x": enemy_x, "enemy_speed": uniform(-30.0, 30.0)}
    return {**columns, "steps": steps, "episode": episode}


def restart(env: PlatformEnv, reading: TensorDictBase, mask: Tensor) -> TensorDictBase:
    """Start new episodes in the rows of `mask` `[N]`."""
    return env.reset(reading.clone().set("_reset", mask.unsqueeze(-1)))


def snapshot(env: PlatformEnv) -> dict[str, Tensor]:
    return {name: column.clone() for name, column in env.state_columns().items()}


def is_as(env: PlatformEnv, before: dict[str, Tensor], rows=slice(None)) -> bool:
    return all(torch.equal(now[rows], before[name][rows]) for name, now in env.state_columns().items())


def numbers_of_next_action(env: PlatformEnv, seed: int) -> list[list[float]]:
    """Return what the random numbers of every environment's next action are, `[N, NUMBERS]`."""
    state = env.state_columns()
    environment = torch.arange(env.num_envs, dtype=torch.int32)
    rng = counter_rng.key_for(counter_rng.seed_tensor(seed), counter_rng.NOISE, environment, state["episode"])
    draw = (state["steps"] * NUMBERS).unsqueeze(-1) + torch.arange(NUMBERS, dtype=torch.int32)
    return counter_rng.normal(rng.unsqueeze(-1), draw).tolist()


def compare(
    env: PlatformEnv, courses: list[ScalarCourse], actions: TensorDict, seed: int, noise: float
) -> tuple[Tensor, list[int]]:
    """Do one action in every unfinished environment and by the published rules; return observation and outcomes."""
    over = env.state_columns()["outcome"] != ON_THE_WAY
    numbers = numbers_of_next_action(env, seed)
    reading = env.step(actions.clone())["next"]
    key, parameter = actions[keys.KEY].tolist(), actions[keys.DURATION].tolist()
    rewards, got_outcomes = reading[keys.REWARD].squeeze(-1).tolist(), reading[keys.OUTCOME].tolist()
    names = ("x", "speed", "enemy_x", "enemy_speed")
    state = list(zip(*(env.state_columns()[name].tolist() for name in names), strict=True))
    outcomes = []
    for i in (~over).nonzero().squeeze(-1).tolist():
        course = courses[i]
        reward, outcome = course.act(key[i], parameter[i][key[i]], [noise * number for number in numbers[i]])
        expected = (course.x, course.speed, *course.enemy, COURSE * reward)
        assert (*state[i], COURSE * rewards[i]) == pytest.approx(expected, abs=0.01), f"environment {i}, key {key[i]}"
        assert got_outcomes[i] == outcome
        outcomes.append(outcome)
    return reading[keys.OBSERVATION], outcomes


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_actions_from_anywhere_follow_the_published_rules(noise):
    num, seed, generator = 500, 5, torch.Generator().manual_seed(1)
    env = PlatformEnv(num, noise=noise, seed=seed)
    place(env, **random_columns(num, generator))
    state = env.state_columns()
    columns = (state[name].tolist() for name in ("x", "speed", "enemy_x", "enemy_speed"))
    courses = [ScalarCourse(*column) for column in zip(*columns, strict=True)]
    outcomes = [
        outcome for _ in range(3) for outcome in compare(env, courses, random_action(env, generator), seed, noise)[1]
    ]
    assert min(outcomes.count(outcome) for outcome in (ON_THE_WAY, ARRIVED, FELL, MET_ENEMY)) > 50


def test_episodes_from_start_to_end_follow_the_published_rules():
    num, seed, generator = 100, 2**40 + 7, torch.Generator().manual_seed(2)
    env = PlatformEnv(num, seed=seed)
    observation, courses = env.reset()[keys.OBSERVATION], [ScalarCourse(0.0, 0.0, 230.0, -30.0) for _ in range(num)]
    ends = []
    for _ in range(12):
        careless = torch.rand(num, 1, generator=generator) < 0.1
        by_rule, by_chance = rule(observation), random_action(env, generator)
        key = torch.where(careless.squeeze(-1), by_chance[keys.KEY], by_rule[keys.KEY])
        parameter = torch.where(careless, by_chance[keys.DURATION], by_rule[keys.DURATION])
        observation, outcomes = compare(env, courses, action(key, parameter), seed, 1.0)
        ends += [outcome for outcome in outcomes if outcome != ON_THE_WAY]
    assert min(ends.count(outcome) for outcome in (ARRIVED, FELL, MET_ENEMY)) > 10
    assert len(ends) == num


@pytest.mark.parametrize(("edge", "inwards"), [(250.0, -1.0), (455.0, 1.0)])
def test_who_comes_down_at_an_edge_is_thrown_out_on_the_shorter_way(edge, inwards):
    env = PlatformEnv(3, noise=0.0)
    place(env, x=200.0, speed=70.0, enemy_x=0.0)
    act(env, [LEAP] * 3, [430.0] * 3)
    flight = env.state_columns()["x"] - 200.0  # which ends in the gap, 1.2 px below the top
    aims = edge + inwards * torch.tensor([-0.5, 0.6, 1.8])
    env.reset()
    place(env, x=aims - flight, speed=70.0, enemy_x=0.0)
    reading = act(env, [LEAP] * 3, [430.0] * 3)
    assert reading[keys.OUTCOME].tolist() == [FELL, FELL, ON_THE_WAY]
    torch.testing.assert_close(env.state_columns()["x"], torch.stack([aims[0], torch.tensor(edge), aims[2]]))


@pytest.mark.parametrize("num", [1, 3])
def test_specs_hold(num):
    check_env_specs(PlatformEnv(num), return_contiguous=True)


def test_learners_get_three_keys_of_one_parameter_each_and_no_options():
    env = PlatformEnv(2)
    specs = PAMDPSpecs.from_env(env)
    assert specs == PAMDPSpecs(9, (), (1, 1, 1), (0.0, 0.0, 0.0), (30.0, 720.0, 430.0))
    assert env.key_names == ("run", "hop", "leap")
    assert not env.has_choice


def test_a_sensible_rule_arrives_with_a_return_of_one():
    env = PlatformEnv(500, seed=3)
    last, total = play(env, rule)
    success = env.results(last.select(*env.result_keys))["success"]
    assert success.float().mean() > 0.95
    torch.testing.assert_close(total[success], torch.ones_like(total[success]))
    assert last[keys.TERMINATED].all()


def test_random_actions_cover_less_than_a_sixth_of_the_course():
    env, generator = PlatformEnv(2000), torch.Generator().manual_seed(0)
    last, total = play(env, lambda _: random_action(env, generator))
    assert last[keys.DONE].all()
    assert total.mean().item() == pytest.approx(0.154, abs=0.01)  # gym-platform has .154, error .002
    torch.testing.assert_close(total, env.state_columns()["x"] / COURSE)  # the rewards sum to the distance covered


def test_a_jump_that_is_too_short_falls():
    env = PlatformEnv(2)
    place(env, x=240.0, speed=0.0, enemy_x=50.0)
    reading = act(env, [HOP, LEAP], [720.0, 430.0])  # from standing
    assert reading[keys.OUTCOME].tolist() == [FELL, FELL]
    assert reading[keys.TERMINATED].all() and not reading[keys.TRUNCATED].any()
    assert (env.state_columns()["x"] < 455.0).all()
    assert (reading[keys.REWARD] > 0.0).all()


def test_who_waits_is_met_by_the_enemy():
    env = PlatformEnv(4)
    last, total = play(env, lambda _: action([RUN] * 4, [0.0] * 4), 9)
    assert last[keys.OUTCOME].tolist() == [MET_ENEMY] * 4
    assert last[keys.TERMINATED].all()
    assert (total == 0.0).all()
    assert not env.results(last)["success"].any()


def test_a_step_limit_truncates_and_an_end_at_it_terminates():
    env = PlatformEnv(2, max_steps=2)
    env.reset()
    assert not act(env, [RUN, RUN], [0.0, 0.0])[keys.DONE].any()
    place(env, x=torch.tensor([0.0, 249.0]), speed=torch.tensor([0.0, 70.0]), enemy_x=100.0)
    reading = act(env, [RUN, RUN], [0.0, 30.0])
    assert reading[keys.TRUNCATED].squeeze(-1).tolist() == [True, False]
    assert reading[keys.TERMINATED].squeeze(-1).tolist() == [False, True]
    assert reading[keys.OUTCOME].tolist() == [TIME_LIMIT, FELL]


def test_only_the_pressed_key_s_parameter_counts_and_is_clipped():
    given, inside = PlatformEnv(4), PlatformEnv(4)
    nan = math.nan
    keys_pressed = [RUN, HOP, LEAP, RUN]
    outside = torch.tensor([[1e9, nan, nan], [nan, 1e9, nan], [nan, nan, 1e9], [-5.0, nan, nan]])
    given.reset(), inside.reset()
    readings = act(given, keys_pressed, outside), act(inside, keys_pressed, [30.0, 720.0, 430.0, 0.0])
    assert (readings[0] == readings[1]).all()


def test_observations_lie_in_their_range_and_tell_where_everybody_is():
    env, generator = PlatformEnv(300), torch.Generator().manual_seed(0)
    place(env, **random_columns(300, generator))
    columns = env.state_columns()
    # A step that is masked for all of them reads the state as it is.
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


def test_an_environment_s_episodes_do_not_depend_on_the_others():
    few, many = PlatformEnv(3, seed=11), PlatformEnv(8, seed=11)
    readings = few.reset(), many.reset()
    for _ in range(6):
        actions = rule(readings[1][keys.OBSERVATION])
        actions[keys.KEY][3:] = RUN
        readings = few.step(actions[:3].clone())["next"], many.step(actions.clone())["next"]
        assert (readings[0] == readings[1][:3]).all()
        # Only some of the others start anew.
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


def test_without_noise_seeds_make_no_difference():
    readings = [play(PlatformEnv(2, noise=0.0, seed=seed), rule, 4)[0] for seed in (0, 1)]
    assert (readings[0] == readings[1]).all()


def test_a_hundred_times_the_noise_still_makes_episodes():
    env, generator = PlatformEnv(200, noise=100.0), torch.Generator().manual_seed(0)
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
    torch.rand(3), np.random.rand(), random.random()
    assert (run() == once).all()


def test_a_partial_reset_leaves_the_others_alone():
    env = PlatformEnv(4)
    env.reset()
    reading = act(env, [RUN] * 4, [10.0] * 4)
    before = snapshot(env)
    mask = torch.tensor([False, True, False, True])
    fresh = restart(env, reading, mask)
    state = env.state_columns()
    assert is_as(env, before, ~mask)
    assert (fresh[keys.OBSERVATION] == reading[keys.OBSERVATION]).all(-1).tolist() == [True, False, True, False]
    assert state["episode"].tolist() == [0, 1, 0, 1]
    assert (state["x"] > 0.0).tolist() == [True, False, True, False]
    assert state["steps"].tolist() == [1, 0, 1, 0]


def test_a_finished_episode_stays_finished_and_earns_nothing():
    env, generator = PlatformEnv(64), torch.Generator().manual_seed(0)
    env.reset()
    env.step(random_action(env, generator))
    before = snapshot(env)
    over = before["outcome"] != ON_THE_WAY
    assert 0 < over.sum() < 64
    after = env.step(random_action(env, generator))["next"]
    assert is_as(env, before, over)
    assert after[keys.DONE][over].all()
    assert (after[keys.REWARD][over] == 0.0).all()
    assert (env.state_columns()["steps"][~over] == 2).all()


def test_what_was_returned_is_never_changed_later():
    env, generator = PlatformEnv(16), torch.Generator().manual_seed(0)
    returned = [env.reset()]
    copies = [returned[0].clone()]
    columns = env.state_columns()
    column_copies = snapshot(env)
    for _ in range(3):
        stepped = env.step(random_action(env, generator))["next"]
        for reading in (stepped, restart(env, stepped, torch.rand(16, generator=generator) < 0.5)):
            returned.append(reading)
            copies.append(reading.clone())
    assert all((now == then).all() for now, then in zip(returned, copies, strict=True))
    assert all(torch.equal(columns[name], column_copies[name]) for name in columns)


def test_a_saved_state_goes_on_as_it_would_have():
    env, copy = PlatformEnv(8, seed=2), PlatformEnv(8, seed=2)
    for _ in range(2):
        play(env, rule, 2)
    copy.set_state_columns(snapshot(env))
    for key in (HOP, RUN, LEAP):
        results = [act(e, [key] * 8, [20.0] * 8) for e in (env, copy)]
        assert (results[0] == results[1]).all()


def test_a_state_of_other_environments_is_refused_and_none_starts_anew():
    env = PlatformEnv(3)
    play(env, rule, 2)
    before = snapshot(env)
    with pytest.raises(ValueError, match=r"x is \[2\], but must be \[3\]"):
        env.set_state_columns(PlatformEnv(2).state_columns())
    with pytest.raises(ValueError, match="not x, speed"):
        env.set_state_columns({name: before[name] for name in ("x", "speed")})
    assert is_as(env, before)
    env.set_state_columns({})
    assert env.state_columns()["steps"].tolist() == [0, 0, 0]
    assert env.state_columns()["episode"].tolist() == [1, 1, 1]


BAD_ACTIONS = {
    "nan": action([RUN, HOP], [0.1, math.nan]),
    "inf": action([RUN, HOP], [math.inf, 0.1]),
    "key too large": action([0, 3], [0.1, 0.1]),
    "key negative": action([-1, 0], [0.1, 0.1]),
    "key of another shape": action([[0], [1]], torch.zeros(2, 3)),
    "one parameter each": action([0, 1], [[0.1], [0.1]]),
    "fractional key": action([0.5, 1.0], [0.1, 0.1]),
    "no key": action([0, 1], [0.1, 0.1]).exclude(keys.KEY),
}


@pytest.mark.parametrize("name", BAD_ACTIONS)
def test_a_bad_action_is_refused_and_harms_nothing(name):
    env = PlatformEnv(2)
    env.reset()
    before = snapshot(env)
    with pytest.raises(ValueError, match="step: "):
        env.step(BAD_ACTIONS[name].clone())
    assert is_as(env, before)


@pytest.mark.parametrize(
    "arguments", [{"num_envs": 0}, {"max_steps": 0}, {"noise": -0.1}, {"noise": math.nan}], ids=str
)
def test_a_bad_argument_is_refused_by_name(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        PlatformEnv(**arguments)
