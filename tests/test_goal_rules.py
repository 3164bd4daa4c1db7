"""The rules of Goal and Hard Goal: slips of the published code, and their repairs. Replays are in test_points.py."""

from __future__ import annotations

import pytest
import torch
from tensor_rules import goal
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.goal import rules
from hpamdp.env.goal.rules import GoalState


def key(episode: Tensor) -> counter_rng.RngKey:
    return counter_rng.rng_key(episode[0], counter_rng.TRAINING, torch.zeros_like(episode), episode)


def state_with(num: int = 1, **columns: float | Tensor) -> GoalState:
    """Return states in the middle of the pitch, with some columns changed."""
    episode = torch.zeros(num, dtype=torch.int32)
    state = goal.start(episode, key(episode), torch.float64)
    changed = {name: torch.as_tensor(value, dtype=torch.float64).expand(num) for name, value in columns.items()}
    return state._replace(**changed)


def own(*values: float) -> Tensor:
    return torch.tensor([values], dtype=torch.float64)


def aimed_at(aim: goal.Aim) -> tuple[float, float]:
    return aim.x.item(), aim.y.item()


def test_a_kick_goes_to_the_diagonal_unless_that_is_repaired():
    kick = torch.tensor([rules.KICK_TO])
    assert aimed_at(goal.goal_aim(kick, own(7.0, -3.0))) == (7.0, 7.0)
    assert aimed_at(goal.goal_aim(kick, own(7.0, -3.0), kicks_to_point=True)) == (7.0, -3.0)
    assert aimed_at(goal.goal_aim(kick, own(50.0, -30.0), kicks_to_point=True)) == (40.0, -15.0)
    assert aimed_at(goal.hard_goal_aim(kick, own(-0.5, 0.2))) == (10.0, 10.0)
    assert aimed_at(goal.hard_goal_aim(kick, own(-0.5, 0.2), kicks_to_point=True)) == pytest.approx((10.0, 3.0))


def test_both_shots_of_goal_are_the_same_and_stay_in_the_goal():
    for shot in (rules.SHOOT_LEFT, rules.SHOOT_RIGHT):
        assert aimed_at(goal.goal_aim(torch.tensor([shot]), own(3.0, 0.0))) == (20.4, 3.0)
        assert aimed_at(goal.goal_aim(torch.tensor([shot]), own(9.0, 0.0))) == (20.4, 7.01)


def test_the_shots_of_hard_goal_aim_at_their_stretches_backwards():
    for first in (1, 6):
        for stretch, (low, high) in enumerate(rules.STRETCHES):
            shot = torch.tensor([first + stretch])
            for parameter, share in ((1.0, low), (-1.0, high)):
                x, y = aimed_at(goal.hard_goal_aim(shot, own(parameter, 0.0)))
                assert (x, y) == (20.4, pytest.approx(7.01 * share, abs=1e-5))


def test_the_middle_of_the_goal_is_only_aimed_at_when_repaired():
    shot = torch.tensor([3])
    published = [aimed_at(goal.hard_goal_aim(shot, own(p, 0.0)))[1] for p in (-1.0, 0.3, 1.0)]
    assert published == pytest.approx([1.402] * 3, abs=1e-5)
    repaired = [aimed_at(goal.hard_goal_aim(shot, own(p, 0.0), has_middle=True))[1] for p in (-1.0, 0.0, 1.0)]
    assert repaired == pytest.approx([1.402, 0.0, -1.402], abs=1e-5)


@pytest.mark.parametrize(
    ("x", "y", "published", "repaired"),
    [
        (15.0, 2.0, 5.0, 5.0),
        (17.0, 11.01, 5.0, 5.0),
        (17.0, -11.01, 5.0, 5.0),
        (21.0, 9.01, 2.0, 2.0),
        (21.0, -9.01, 16.02, 2.0),
        (23.0, 3.0, 0.0, 0.0),
    ],
)
def test_the_goal_distance_is_too_large_behind_the_line_below_unless_repaired(x, y, published, repaired):
    state = state_with(ball_x=x, ball_y=y)
    assert goal.goal_distance(state).item() == pytest.approx(published)
    assert goal.goal_distance(state, is_repaired=True).item() == pytest.approx(repaired)


def test_the_keepers_projection_is_clipped_too_high_unless_repaired():
    def projection(**options: bool) -> list[float]:
        state = state_with(3, keeper_x=10.0, keeper_y=0.0, ball_x=9.0, ball_y=torch.tensor([-3.0, 1.2, 3.0]))
        return goal.observe(state, is_scaled=False, **options)[:, -1].tolist()

    assert projection() == pytest.approx([14.02, -7.01, -7.01])
    assert projection(repairs_projection=True) == pytest.approx([7.01, -7.01, -7.01])
    level = state_with(2, keeper_x=9.0, keeper_y=0.0, ball_x=9.0, ball_y=torch.tensor([3.0, -3.0]))
    assert goal.observe(level, is_scaled=False)[:, -1].tolist() == [-7.01, 7.01]


def test_every_ball_lies_in_reach_at_the_start():
    num = 20_000
    episode = torch.arange(num, dtype=torch.int32)
    state = goal.start(episode, key(episode))
    aim = goal.goal_aim(torch.full((num,), rules.SHOOT_LEFT), torch.zeros(num, 2))
    after = goal.tick(state[:14], aim.x, aim.y, torch.zeros(6, num))
    assert (after[rules.COLUMNS.index("ball_vx")] > 0.0).all()
    assert (state.player_y.abs() < 15.0).all() and state.player_y.std().item() == pytest.approx(8.66, abs=0.1)


def test_bodies_in_the_same_place_and_positions_that_are_not_finite_end_an_action():
    state = state_with(2, keeper_x=5.0, keeper_y=0.0, ball_x=torch.tensor([5.0, float("nan")]), ball_y=0.0)
    aim = goal.goal_aim(torch.tensor([1, 1]), torch.zeros(2, 2, dtype=torch.float64))
    moves = torch.tensor([True, True])
    after, _ = goal.act(state, aim, moves, lambda ticks, rows: torch.zeros(len(ticks), 6, len(rows)))
    assert after.outcome.tolist() == [rules.CAUGHT, rules.OUT]
