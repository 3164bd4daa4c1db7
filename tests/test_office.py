"""Office follows its rules, which are written down here once more for one agent, in plain Python."""

from __future__ import annotations

import itertools
import json
import os
import random
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import make_config
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

import hpamdp
from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.decisions import with_decisions
from hpamdp.env.office import player, rules
from hpamdp.env.office.environment import OfficeEnv
from hpamdp.env.office.rules import COFFEE, DOWN, LEFT, MAIL, RIGHT, TARGET, UP, OfficeState
from hpamdp.run.assemble import assemble

MAP = Path(os.environ.get("HPAMDP_TRACES", "nowhere")) / "domains" / "office_map.json"
POINT = tuple[float, float]


def wall_polygons() -> list[list[POINT]]:
    """Return the walls as polygons of points (y, x): borders, and two walls with three doors each along both axes."""
    ends = {0.32: (0.0, 0.1, 0.2, 0.45, 0.55, 0.8, 0.9, 1.0), 0.66: (0.0, 0.1, 0.2, 0.45, 0.55, 0.8, 0.9, 1.0)}
    boxes = [(0.0, 1.0, 0.0, 0.01), (0.0, 0.01, 0.0, 1.0), (0.99, 1.0, 0.0, 1.0), (0.0, 1.0, 0.99, 1.0)]
    for at, (*cuts,) in ends.items():
        for first, last in zip(cuts[::2], cuts[1::2], strict=True):
            upright_last = 0.44 if (at, last) == (0.66, 0.45) else last  # the one door that is wider
            boxes += [(first, upright_last, at, at + 0.01), (at, at + 0.01, first, last)]
    return [[(top, left), (top, right), (bottom, right), (bottom, left)] for top, bottom, left, right in boxes]


class ScalarOffice:
    """The rules for one agent in double precision; walls are polygons."""

    PLACES = ((0.1, 0.8), (0.54, 0.55), (0.95, 0.95))  # y, x

    def __init__(self, y: float = 0.05, x: float = 0.05, has_coffee: bool = False, has_mail: bool = False) -> None:
        self.at = (y, x)
        self.has = [has_coffee, has_mail]
        self.walls = wall_polygons()

    def goal(self, option: int) -> int:
        """Return what the agent goes for if it has chosen an option."""
        if all(self.has):
            return TARGET
        return option if option != TARGET and not self.has[option] else self.has.index(False)

    def move(self, discrete: int, length: float, slips: bool, option: int | None) -> tuple[float, bool]:
        """Return the reward and whether the agent has delivered."""
        along_y = discrete in (UP, DOWN)
        along_y = not along_y if slips else along_y
        y, x = self.at
        to = (y + length, x) if along_y else (y, x + length)
        is_inside = 0.0 <= to[0] < 1.0 and 0.0 <= to[1] < 1.0
        if not is_inside or any(holds(wall, to) or touches(wall, self.at, to) for wall in self.walls):
            return -2.0, False
        self.at = to
        near = [abs(to[0] - at[0]) <= 0.06 and abs(to[1] - at[1]) <= 0.06 for at in self.PLACES]
        goal = None if option is None else self.goal(option)
        for item in (COFFEE, MAIL):
            if near[item] and not self.has[item] and goal in (None, item):
                self.has[item] = True
                return 0.0, False
        return (1000.0, True) if near[TARGET] and all(self.has) else (-1.0, False)


def holds(polygon: list[POINT], point: POINT) -> bool:
    """Return whether a point lies in a polygon, by the crossings of a ray."""
    crossings = 0
    for (y1, x1), (y2, x2) in itertools.pairwise([*polygon, polygon[0]]):
        if (y1 > point[0]) != (y2 > point[0]):
            crossings += point[1] < x1 + (point[0] - y1) * (x2 - x1) / (y2 - y1)
    return crossings % 2 == 1


def touches(polygon: list[POINT], start: POINT, end: POINT) -> bool:
    """Return whether a line touches an edge of a polygon, by the sides on which the ends lie."""

    def side(a: POINT, b: POINT, c: POINT) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    def is_between(a: POINT, b: POINT, c: POINT) -> bool:
        return all(min(p, q) <= r <= max(p, q) for p, q, r in zip(a, b, c, strict=True))

    for a, b in itertools.pairwise([*polygon, polygon[0]]):
        s = side(start, end, a), side(start, end, b), side(a, b, start), side(a, b, end)
        if s[0] * s[1] < 0.0 and s[2] * s[3] < 0.0:
            return True
        lies_on = ((start, end, a), (start, end, b), (a, b, start), (a, b, end))
        if any(value == 0.0 and is_between(*points) for value, points in zip(s, lies_on, strict=True)):
            return True
    return False


def state_of(places: list[POINT], coffee: list[bool], mail: list[bool]) -> OfficeState:
    """Return a float64 state of agents at places (y, x)."""
    none = torch.zeros(len(places), dtype=torch.int32)
    y, x = torch.tensor(places, dtype=torch.float64).unbind(-1)
    return OfficeState(x, y, torch.tensor(coffee).int(), torch.tensor(mail).int(), none, none, none)


@pytest.mark.parametrize("chooses_goal", [False, True])
def test_moves_from_anywhere_follow_the_rules_step_by_step_in_float64(chooses_goal):
    chance = random.Random(4)
    offices = []
    while len(offices) < 150:
        near = chance.choice([*ScalarOffice.PLACES, None])
        place = [chance.random(), chance.random()] if near is None else [at + chance.uniform(-0.1, 0.1) for at in near]
        office = ScalarOffice(*place, chance.random() < 0.6, chance.random() < 0.6)
        if all(0.0 < at < 1.0 for at in place) and not any(holds(wall, office.at) for wall in office.walls):
            offices.append(office)
    state = state_of([office.at for office in offices], *zip(*(office.has for office in offices), strict=True))
    met = set()
    for _ in range(12):
        discrete = [chance.randrange(4) for _ in offices]
        length = [chance.choice([0.05, chance.uniform(0.0, 0.05)]) * (-1, 1, -1, 1)[d] for d in discrete]
        slips = [chance.random() < 0.3 for _ in offices]
        option = [chance.randrange(3) if chooses_goal else None for _ in offices]
        taken = zip(offices, discrete, length, slips, option, strict=True)
        expected = [office.move(*move) for office, *move in taken]
        state, reward = rules.act(
            state,
            torch.tensor(discrete),
            torch.tensor(length, dtype=torch.float64),
            torch.tensor(slips),
            torch.tensor(option) if chooses_goal else None,
        )
        assert reward.tolist() == [each for each, _ in expected]
        assert list(zip(state.y.tolist(), state.x.tolist(), strict=True)) == [office.at for office in offices]
        assert [*zip(state.coffee.tolist(), state.mail.tolist(), strict=True)] == [(*office.has,) for office in offices]
        assert state.outcome.tolist() == [int(is_over) for _, is_over in expected]
        met |= {each for each, _ in expected}
        assert (state.steps > 0).all()
    assert met == {-2.0, -1.0, 0.0, 1000.0}


@pytest.mark.parametrize("chooses_goal", [False, True])
def test_the_kernel_moves_as_the_rules_say(chooses_goal):
    num, slip, seed = 2_000, 0.3, 5
    env = OfficeEnv(num, slip=slip, chooses_goal=chooses_goal, seed=seed)
    td, environment = env.reset(), torch.arange(num, dtype=torch.int32)
    generator, met = torch.Generator().manual_seed(1), set()
    for _ in range(12):
        # Near a place every time, so that all is met.
        near = torch.tensor(rules.PLACES)[torch.randint(3, (num,), generator=generator)]
        x, y = (near + 0.2 * torch.rand(num, 2, generator=generator) - 0.1).clamp(0.02, 0.98).unbind(-1)
        env.state = before = env.state._replace(x=x, y=y)
        rng = counter_rng.rng_key(counter_rng.seed_tensor(seed), counter_rng.NOISE, environment, before.episode)
        taken = env.rand_action(td)
        discrete, option = taken[keys.DISCRETE], taken[keys.OPTION] if chooses_goal else None
        length = taken[keys.PARAMETERS].gather(-1, discrete.unsqueeze(-1)).squeeze(-1)
        slips = counter_rng.uniform(rng, before.steps) < slip
        expected, reward = rules.act(before, discrete, length, slips, option)
        goes_on = before.outcome == rules.ON_THE_WAY
        td = env.step(taken)["next"]
        got = [*env.state, td[keys.REWARD].squeeze(-1)]
        same = torch.stack([torch.isclose(*pair) for pair in zip(got, [*expected, reward], strict=True)]).all(0)
        assert (~same & goes_on).sum() <= 1, "where a threshold is met to within rounding"
        met |= {*reward[goes_on].tolist()}
    assert met == {-2.0, -1.0, 0.0, 1000.0}


@pytest.mark.skipif(not MAP.exists(), reason="HPAMDP_TRACES is not set")
def test_the_walls_are_those_of_the_published_map():
    polygons = json.loads(MAP.read_text())["polygons_xy"]  # whose points are (y, x) of the state
    published = set()
    for polygon in polygons:
        y, x = zip(*polygon, strict=True)
        published.add((min(x), max(x), min(y), max(y)))
    assert {*rules.WALLS} == published and len(rules.WALLS) == len(polygons) == 20


def moved(place: POINT, discrete: int, length: float, *, slips: bool = False, has: tuple[bool, bool] = (False, False)):
    """Return place (y, x), reward and outcome after one move."""
    state = state_of([place], [has[0]], [has[1]])
    length = torch.tensor([length], dtype=torch.float64)
    after, reward = rules.act(state, torch.tensor([discrete]), length, torch.tensor([slips]))
    return (after.y.item(), after.x.item()), reward.item(), after


@pytest.mark.parametrize(
    ("place", "discrete", "length"),
    [
        ((0.25, 0.3), RIGHT, 0.05),  # through a wall
        ((0.25, 0.3), RIGHT, 0.025),  # into it
        ((0.25, 0.25), RIGHT, 0.07),  # up to its edge
        ((0.1, 0.3), RIGHT, 0.05),  # along its end
        ((0.05, 0.05), UP, -0.05),  # the border
        ((0.985, 0.5), DOWN, 0.05),  # out of the office
    ],
)
def test_a_move_that_touches_a_wall_is_refused_costs_two_and_changes_nothing(place, discrete, length):
    to, reward, after = moved(place, discrete, length)
    assert to == place and reward == -2.0 and after.steps.item() == 1


def test_an_episode_begins_at_the_start_and_lasts_400_steps():
    env = OfficeEnv(2)
    td = env.reset()
    torch.testing.assert_close(td[keys.OBSERVATION], torch.tensor([[-0.9, -0.9, -1.0, -1.0]] * 2))
    still = TensorDict({keys.ACTION: {"discrete": torch.tensor([UP, LEFT]), "parameters": torch.zeros(2, 4)}}, [2])
    for _ in range(399):
        assert not env.step(still)["next"][keys.DONE].any()
    last = env.step(still)["next"]
    assert last[keys.TRUNCATED].all() and not last[keys.TERMINATED].any()


@pytest.mark.parametrize(("slip", "share"), [(0.1, 0.1), (1.0, 1.0)])
def test_moves_slip_with_the_probability_that_is_set(slip, share):
    num = 20_000
    env = OfficeEnv(num, slip=slip, seed=3)
    td = env.reset()
    td[keys.ACTION] = TensorDict(
        discrete=torch.full((num,), DOWN), parameters=torch.full((num, 4), 0.01), batch_size=num
    )
    has_slipped = env.step(td)["next", keys.OBSERVATION][:, 1] > -0.89
    assert has_slipped.float().mean().item() == pytest.approx(share, abs=0.01)


def play(env: OfficeEnv, option: int = 0, *, begins: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
    """Play the hand-written player's episodes with an option; return returns and outcomes `[N]`."""
    td = env.reset() if begins else env.read()
    total = torch.zeros(env.num_envs)
    for _ in range(env.max_steps):
        discrete, length = (each[:, option] for each in env.scripted_action(env.state))
        td[keys.ACTION] = TensorDict(
            discrete=discrete, parameters=length.unsqueeze(-1).expand(-1, 4), batch_size=[env.num_envs]
        )
        if env.has_choice:
            td[keys.OPTION] = torch.full((env.num_envs,), option)
        after = env.step(td)["next"]
        total = total + after[keys.REWARD].squeeze(-1)
        td = after.exclude(keys.REWARD)
        if td[keys.DONE].all():
            break
    return total, td[keys.OUTCOME]


def value_at_the_start(values: torch.Tensor, option: int = 0) -> float:
    return values[option, 0].reshape(100, 100)[5, 5].item()


def test_the_player_that_knows_the_map_delivers_and_returns_what_its_values_promise():
    env = OfficeEnv(1000, seed=2)
    returns, outcomes = play(env)
    assert (outcomes == rules.DELIVERED).all()
    promised = value_at_the_start(player.best_values(0.1, False))
    assert promised == pytest.approx(956.4, abs=0.1)
    assert abs(returns.mean().item() - promised) < 3.0 * returns.std().item() / 1000**0.5


def test_the_player_finds_its_way_from_off_its_grid():
    env = OfficeEnv(300, seed=2)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    x, y = (low + 0.3 * torch.rand(300, generator=generator) for low in (0.012, 0.68))
    env.set_env_state({**env.env_state(), "x": x, "y": y})
    returns, outcomes = play(env, begins=False)
    assert (outcomes == rules.DELIVERED).all() and returns.mean() > 930.0


def test_the_players_values_solve_the_bellman_equation_of_the_rules_written_here():
    slip, size, spacing = 0.1, 100, 0.00999
    values = player.best_values(slip, False)[0].tolist()
    chance = random.Random(1)
    compared = 0
    while compared < 60:
        held, row, column = chance.randrange(4), chance.randrange(size), chance.randrange(size)
        place = (0.05 + spacing * (row - 5), 0.05 + spacing * (column - 5))
        if any(holds(wall, place) for wall in wall_polygons()):
            continue
        best = -1e9
        for discrete, number in itertools.product(range(4), range(1, 6)):
            expected = 0.0
            for slips, probability in ((False, 1.0 - slip), (True, slip)):
                office = ScalarOffice(*place, bool(held & 1), bool(held & 2))
                reward, is_over = office.move(discrete, spacing * number * (-1, 1, -1, 1)[discrete], slips, None)
                to_row, to_column = (5 + round((at - 0.05) / spacing) for at in office.at)
                after = values[office.has[0] + 2 * office.has[1]][to_row * size + to_column]
                expected += probability * (reward + (0.0 if is_over else after))
            best = max(best, expected)
        assert values[held][row * size + column] == pytest.approx(best, abs=1e-5)
        compared += 1


@pytest.mark.parametrize(("option", "first"), [(COFFEE, "coffee"), (MAIL, "mail"), (TARGET, "coffee")])
def test_with_a_chosen_goal_the_agent_takes_that_first(option, first):
    env = OfficeEnv(100, chooses_goal=True, seed=3)
    returns, outcomes = play(env, option)
    assert (outcomes == rules.DELIVERED).all()
    promised = value_at_the_start(player.best_values(0.1, True), option)
    assert abs(returns.mean().item() - promised) < 4.0 * returns.std().item() / 100**0.5
    other = {"coffee": (0.54, 0.55), "mail": (0.1, 0.8)}[first]
    state = state_of([other], [False], [False])
    still = torch.zeros(1, dtype=torch.float64)
    after, reward = rules.act(state, torch.tensor([DOWN]), still, torch.tensor([False]), torch.tensor([option]))
    assert reward.item() == -1.0 and after.coffee.item() == after.mail.item() == 0


@pytest.mark.parametrize(("has", "is_open"), [((0, 0), (True, True, False)), ((1, 1), (False, False, True))])
def test_the_mask_of_options_says_which_goals_are_open(has, is_open):
    env = OfficeEnv(1, chooses_goal=True)
    env.reset()
    columns = {"coffee": torch.tensor([has[0]]).int(), "mail": torch.tensor([has[1]]).int()}
    env.set_env_state({**env.env_state(), **columns})
    assert env.read()[keys.OPTION_MASK].tolist() == [[*is_open]]


def test_an_agent_that_chooses_goals_acts_in_gymnasium_whose_infos_say_which_are_open():
    sizes = {"num_envs": 4, "steps_per_batch": 4, "total_frames": 16, "eval.layouts": 2, "max_steps": 20}
    agent = hpamdp.train("office", chooses_goal=True, high="uniform", low="random", progress=False, **sizes)
    env = hpamdp.make_gymnasium("office", chooses_goal=True)
    observation, info = env.reset(seed=0)
    assert info["option_mask"].tolist() == [True, True, False]
    env.unwrapped._env.state = env.unwrapped._env.state._replace(coffee=torch.ones(1, dtype=torch.int32))
    for _ in range(3):
        action = agent.act(observation, info)
        observation, *_, info = env.step(action)
        assert info["option_mask"].tolist() == [False, True, False]
    many = hpamdp.make_gymnasium("office", num_envs=3, chooses_goal=True)
    observations, infos = many.reset(seed=0)
    agent.reset()
    assert all(many.single_action_space.spaces[0].contains(option) for option in agent.act(observations, infos)[0])
    _, infos = many.reset(options={"reset_mask": np.array([True, False, False])})
    assert infos["option_mask"].tolist() == [[True, True, False], [False] * 3, [False] * 3]
    assert infos["_option_mask"].tolist() == [True, False, False]


def test_all_tensors_are_as_the_specs_say_if_the_agent_chooses_its_goal():
    check_env_specs(with_decisions(OfficeEnv(3, max_steps=4, oracle=True, chooses_goal=True), 0.9, 2))


@pytest.mark.parametrize("words", [["high=none"], ["high=uniform", "env.chooses_goal=true"]], ids=["any", "chosen"])
def test_the_planner_plays_the_player_with_and_without_options(words):
    parts = assemble(make_config(["env=office", "low=planner", *words, "num_envs=4", "eval.layouts=50"]))
    played = parts.evaluation.run(parts.agent.policy)
    assert played["success"].all() and played["score"].mean() > 940.0


def test_an_option_ends_when_its_goal_is_reached_if_the_selector_decides_on_ends():
    words = ["env=office", "env.chooses_goal=true", "high=meta_critic", "low=planner", "agent.termination=learned"]
    parts = assemble(make_config([*words, "num_envs=4", "eval.layouts=20"]))
    td = parts.env.rollout(120, parts.agent.policy, break_when_any_done=False)
    option, mask = td[keys.OPTION], td[keys.OPTION_MASK]
    assert mask.gather(-1, option.unsqueeze(-1)).all()
    assert {*option.flatten().tolist()} == {COFFEE, MAIL, TARGET}
