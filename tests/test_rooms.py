"""Rooms: its rules, and its best values against players that search."""

import itertools

import pytest
import torch
from conftest import make_config
from tensordict import TensorDict
from torchrl.envs import check_env_specs

from hpamdp import keys
from hpamdp.env.decisions import with_decisions
from hpamdp.env.rooms import rules
from hpamdp.env.rooms.environment import RoomsEnv
from hpamdp.env.rooms.rules import BOOTS, GOAL, SKATES
from hpamdp.run.assemble import assemble

UP, RIGHT, DOWN, LEFT = range(4)


def moved(x: int, y: int, option: int, direction: int, fraction: float) -> tuple[int, int]:
    whole = [torch.tensor([value]) for value in (x, y, option, direction)]
    return tuple(part.item() for part in rules.move(*whole, torch.tensor([fraction])))


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((0, 0, SKATES, RIGHT, 1.0), (3, 0)),
        ((0, 0, SKATES, RIGHT, 0.6), (2, 0)),
        ((0, 0, SKATES, RIGHT, 0.1), (0, 0)),
        ((0, 0, BOOTS, RIGHT, 1.0), (1, 0)),
        ((0, 0, BOOTS, RIGHT, 0.4), (0, 0)),
        ((3, 0, SKATES, RIGHT, 1.0), (4, 0)),  # the wall
        ((3, 2, SKATES, RIGHT, 1.0), (6, 2)),  # through the doorway
        ((5, 2, BOOTS, RIGHT, 1.0), (6, 2)),  # neither suits a doorway
        ((6, 2, BOOTS, DOWN, 1.0), (6, 4)),
        ((6, 2, SKATES, DOWN, 1.0), (6, 3)),
        ((0, 0, SKATES, UP, 1.0), (0, 0)),
        ((9, 10, SKATES, RIGHT, 1.0), (GOAL, GOAL)),
    ],
)
def test_a_move_goes_as_far_as_the_option_the_floor_and_the_walls_let_it(before, after):
    assert moved(*before) == after


def test_all_tensors_are_as_the_specs_say():
    check_env_specs(with_decisions(RoomsEnv(3), 0.9, 2))


def test_the_best_values_are_those_of_exhaustive_search_near_the_goal():
    gamma, cost = 0.9, rules.STEP_COST

    def search(x: int, y: int, depth: int) -> float:
        if depth == 0:
            return -1e9
        best = -1e9
        for option, direction, fraction in itertools.product(range(2), range(4), (1 / 3, 2 / 3, 1.0)):
            to = moved(x, y, option, direction, fraction)
            following = 1.0 if to == (GOAL, GOAL) else gamma * search(*to, depth - 1)
            best = max(best, following - cost)
        return best

    best = rules.best_values(gamma, 1)
    for cell in ((9, 10), (7, 10), (8, 8)):
        assert best[cell].item() == pytest.approx(search(*cell, 2))
    assert best[GOAL, GOAL] == 0.0


def test_longer_options_are_worth_less_and_a_single_one_least():
    start = slice(0, rules.WALL)
    values = [rules.best_values(1.0, length)[start, start].mean().item() for length in (1, 3, 50)]
    assert values[0] > values[1] > values[2] > 0.0


def test_episodes_begin_in_the_first_room_and_end_at_the_goal_or_with_the_time_limit():
    env = RoomsEnv(500, max_steps=3)
    td = env.reset()
    assert env.position.amax() == rules.WALL - 1 and env.position.amin() == 0
    env.set_env_state({**env.env_state(), "x": torch.full((500,), GOAL), "y": torch.full((500,), GOAL - 1)})
    for step in range(3):
        direction = torch.where(torch.arange(500) < 250, DOWN, RIGHT)
        action = {"discrete": direction, "parameters": torch.ones(500, 4)}
        td = env.step(TensorDict({"option": torch.zeros(500).long(), "action": action}, [500]))["next"]
        assert td[keys.TERMINATED][:250].all() and not td[keys.TERMINATED][250:].any()
        assert td[keys.REWARD][0].item() == pytest.approx(0.98 if step == 0 else 0.0)
        assert td[keys.TRUNCATED][250:].all() == (step == 2)


def test_an_unknown_option_is_refused_in_one_line():
    env = RoomsEnv(2)
    env.reset()
    action = {"discrete": torch.zeros(2).long(), "parameters": torch.ones(2, 4)}
    with pytest.raises(ValueError, match=r"environment 1 got option=2 \(allowed 0 to 1\)"):
        env.step(TensorDict({"option": torch.tensor([0, 2]), "action": action}, [2]))


def test_an_evaluation_knows_the_ceiling():
    words = "env=rooms high=uniform low=random agent.termination=steps agent.option_length=1 num_envs=4 eval.layouts=50"
    parts = assemble(make_config(words.split()))
    means = parts.evaluation.measure(parts.evaluation.run(parts.agent.policy))
    assert 0.8 < means["ceiling"] < 0.9 and means["score"] < means["ceiling"]


def test_a_film_shows_the_floors_and_where_the_agent_goes():
    env = RoomsEnv(1)
    first = env.reset()
    states = [env.env_state()]
    first["option"] = torch.tensor([rules.SKATES])
    first["action", "discrete"] = torch.tensor([1])
    first["action", "parameters"] = torch.ones(1, 4)
    env.step(first)
    pictures = list(env.film([*states, env.env_state()], 4.0, 240))
    assert len(pictures) == 2 and pictures[0].shape == (240, 240, 3)
    assert (pictures[0] != pictures[1]).any()
    assert len({tuple(colour) for colour in pictures[0].reshape(-1, 3)[::7]}) > 5
