"""The rules of Goal and Hard Goal agree with episodes that were recorded from the published code."""

from __future__ import annotations

import pytest
import torch
from goal_players import Trace
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.goal import rules
from hpamdp.env.goal.rules import GoalState

DOMAINS = ["goal", "hard_goal"]


@pytest.mark.parametrize("domain", DOMAINS)
def test_recorded_episodes_are_played_through_to_the_last_digit(domain):
    trace = Trace(domain, torch.float64)
    episodes = trace.episodes
    state = trace.state([episode["initial"]["state"] for episode in episodes])
    scaled = trace.tensor([episode["initial"]["scaled_observation"] for episode in episodes])
    torch.testing.assert_close(rules.observe(state), scaled, rtol=0.0, atol=1e-9)
    for number in range(max(len(episode["steps"]) for episode in episodes)):
        going = [len(episode["steps"]) > number for episode in episodes]
        episodes = [episode for episode, goes in zip(episodes, going, strict=True) if goes]
        state = GoalState(*(column[torch.tensor(going)] for column in state))
        steps = [episode["steps"][number] for episode in episodes]
        played = trace.play(state, steps)
        trace.check(steps, played, 1e-9)
        state = played[0]


@pytest.mark.parametrize("domain", DOMAINS)
def test_every_recorded_action_does_what_it_did_in_float32(domain):
    trace = Trace(domain, torch.float32)
    before, steps = [], []
    for episode in trace.episodes:
        before += [episode["initial"]["state"], *(step["state"] for step in episode["steps"][:-1])]
        steps += episode["steps"]
    trace.check(steps, trace.play(trace.state(before), steps), 2e-4)


@pytest.mark.parametrize("domain", DOMAINS)
def test_recorded_ticks_are_met_one_by_one(domain):
    trace = Trace(domain, torch.float64)
    before, after, draws, steps = [], [], [], []
    for episode in trace.episodes:
        last = episode["initial"]["state"]
        for step in episode["steps"]:
            states = step.get("tick_states") or []
            before += [last, *states[:-1]] if states else []
            after += states
            draws += step["draws"][: len(states)]
            steps += [step] * len(states)
            last = step["state"]
    aim = trace.aim(steps)
    bodies = rules.tick(trace.bodies(before), aim.x, aim.y, trace.tensor(draws).T)
    torch.testing.assert_close(torch.stack(bodies), torch.stack(trace.bodies(after)), rtol=0.0, atol=1e-9)
    assert len(after) > 50


def key(episode: Tensor) -> counter_rng.RngKey:
    return counter_rng.rng_key(episode[0], counter_rng.TRAINING, torch.zeros_like(episode), episode)


def state_with(num: int = 1, **columns: float | Tensor) -> GoalState:
    """Return states in the middle of the pitch, with some columns changed."""
    episode = torch.zeros(num, dtype=torch.int32)
    state = rules.start(episode, key(episode), torch.float64)
    changed = {name: torch.as_tensor(value, dtype=torch.float64).expand(num) for name, value in columns.items()}
    return state._replace(**changed)


def own(*values: float) -> Tensor:
    return torch.tensor([values], dtype=torch.float64)


def aimed_at(aim: rules.Aim) -> tuple[float, float]:
    return aim.x.item(), aim.y.item()


def test_a_kick_goes_to_the_diagonal_unless_that_is_repaired():
    kick = torch.tensor([rules.KICK_TO])
    assert aimed_at(rules.goal_aim(kick, own(7.0, -3.0))) == (7.0, 7.0)
    assert aimed_at(rules.goal_aim(kick, own(7.0, -3.0), kicks_to_point=True)) == (7.0, -3.0)
    assert aimed_at(rules.goal_aim(kick, own(50.0, -30.0), kicks_to_point=True)) == (40.0, -15.0)
    assert aimed_at(rules.hard_goal_aim(kick, own(-0.5, 0.2))) == (10.0, 10.0)
    assert aimed_at(rules.hard_goal_aim(kick, own(-0.5, 0.2), kicks_to_point=True)) == pytest.approx((10.0, 3.0))


def test_both_shots_of_goal_are_the_same_and_stay_in_the_goal():
    for shot in (rules.SHOOT_LEFT, rules.SHOOT_RIGHT):
        assert aimed_at(rules.goal_aim(torch.tensor([shot]), own(3.0, 0.0))) == (20.4, 3.0)
        assert aimed_at(rules.goal_aim(torch.tensor([shot]), own(9.0, 0.0))) == (20.4, 7.01)


def test_the_shots_of_hard_goal_aim_at_their_stretches_backwards():
    for first in (1, 6):
        for stretch, (low, high) in enumerate(rules.STRETCHES):
            shot = torch.tensor([first + stretch])
            for parameter, share in ((1.0, low), (-1.0, high)):
                x, y = aimed_at(rules.hard_goal_aim(shot, own(parameter, 0.0)))
                assert (x, y) == (20.4, pytest.approx(7.01 * share, abs=1e-5))


def test_the_middle_of_the_goal_is_only_aimed_at_when_repaired():
    shot = torch.tensor([3])
    published = [aimed_at(rules.hard_goal_aim(shot, own(p, 0.0)))[1] for p in (-1.0, 0.3, 1.0)]
    assert published == pytest.approx([1.402] * 3, abs=1e-5)
    repaired = [aimed_at(rules.hard_goal_aim(shot, own(p, 0.0), has_middle=True))[1] for p in (-1.0, 0.0, 1.0)]
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
    assert rules.goal_distance(state).item() == pytest.approx(published)
    assert rules.goal_distance(state, is_repaired=True).item() == pytest.approx(repaired)


def test_the_keepers_projection_is_clipped_too_high_unless_repaired():
    def projection(**options: bool) -> list[float]:
        state = state_with(3, keeper_x=10.0, keeper_y=0.0, ball_x=9.0, ball_y=torch.tensor([-3.0, 1.2, 3.0]))
        return rules.observe(state, is_scaled=False, **options)[:, -1].tolist()

    assert projection() == pytest.approx([14.02, -7.01, -7.01])
    assert projection(repairs_projection=True) == pytest.approx([7.01, -7.01, -7.01])
    level = state_with(2, keeper_x=9.0, keeper_y=0.0, ball_x=9.0, ball_y=torch.tensor([3.0, -3.0]))
    assert rules.observe(level, is_scaled=False)[:, -1].tolist() == [-7.01, 7.01]


def test_every_ball_lies_in_reach_at_the_start():
    num = 20_000
    episode = torch.arange(num, dtype=torch.int32)
    state = rules.start(episode, key(episode))
    aim = rules.goal_aim(torch.full((num,), rules.SHOOT_LEFT), torch.zeros(num, 2))
    after = rules.tick(state[:14], aim.x, aim.y, torch.zeros(6, num))
    assert (after[rules.COLUMNS.index("ball_vx")] > 0.0).all()
    assert (state.player_y.abs() < 15.0).all() and state.player_y.std().item() == pytest.approx(8.66, abs=0.1)


def test_bodies_in_the_same_place_and_positions_that_are_not_finite_end_an_action():
    state = state_with(2, keeper_x=5.0, keeper_y=0.0, ball_x=torch.tensor([5.0, float("nan")]), ball_y=0.0)
    aim = rules.goal_aim(torch.tensor([1, 1]), torch.zeros(2, 2, dtype=torch.float64))
    moves = torch.tensor([True, True])
    after, _ = rules.act(state, aim, moves, lambda ticks, rows: torch.zeros(len(ticks), 6, len(rows)))
    assert after.outcome.tolist() == [rules.CAUGHT, rules.OUT]
