"""The rules of Goal and Hard Goal agree with episodes that were recorded from the published code."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from tensor_rules import goal
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.goal import rules
from hpamdp.env.goal.rules import GoalState

DOMAINS = ["goal", "hard_goal"]
AIMS = {"goal": goal.goal_aim, "hard_goal": goal.hard_goal_aim}
OUTCOME_CODES = {"": rules.PLAYING, "goal": rules.GOAL, "caught": rules.CAUGHT, "out": rules.OUT}
OUTCOME_CODES["limit"] = rules.TIME_LIMIT


class Trace:
    """The recorded episodes of Goal or Hard Goal, all of them side by side.

    Args:
        domain: `goal` or `hard_goal`.
        dtype: of all tensors.
    """

    def __init__(self, domain: str, dtype: torch.dtype) -> None:
        folder = os.environ.get("HPAMDP_TRACES")
        file = Path(folder or ".", "domains", f"{domain}.json")
        if folder is None or not file.exists():
            pytest.skip("HPAMDP_TRACES names no folder with domains/")
        self._recorded = json.loads(file.read_text())
        self._aim = AIMS[domain]
        self.dtype = dtype
        self.episodes = self._recorded["episodes"]

    def bodies(self, states: Sequence[Sequence[float]]) -> list[Tensor]:
        """Return the COLUMNS of recorded states, `[M]` each."""
        columns = dict(zip(self._recorded["state_names"], zip(*states, strict=False), strict=False))
        return [torch.tensor(columns[name], dtype=self.dtype) for name in rules.COLUMNS]

    def state(self, states: Sequence[Sequence[float]]) -> GoalState:
        """Return recorded states as those of `[M]` environments."""
        steps = torch.tensor([state[-1] for state in states], dtype=torch.int32)
        return GoalState(*self.bodies(states), steps, torch.zeros_like(steps), torch.zeros_like(steps))

    def tensor(self, values: Sequence[Any]) -> Tensor:
        return torch.tensor(values, dtype=self.dtype)

    def aim(self, steps: Sequence[Mapping[str, Any]]) -> goal.Aim:
        """Return what is aimed at in recorded steps, `[M]`."""
        own = self.tensor([(*step["parameters"], 0.0)[:2] for step in steps])
        return self._aim(torch.tensor([step["action"] for step in steps]), own)

    def play(self, state: GoalState, steps: Sequence[Mapping[str, Any]]) -> tuple[GoalState, Tensor, Tensor]:
        """Return the states after recorded actions, the rewards and the ticks, `[M]` each."""
        draws = [self.tensor(step["draws"]).reshape(-1, rules.NUMBERS_PER_TICK) for step in steps]
        drawn = torch.nn.utils.rnn.pad_sequence(draws)
        drawn = torch.cat([drawn, drawn.new_zeros(16, *drawn.shape[1:])]).transpose(1, 2)  # [T, 6, M]
        after, ticks = goal.act(
            state,
            self.aim(steps),
            torch.ones(len(steps), dtype=torch.bool),
            lambda ticks, rows: drawn[ticks.long()][:, :, rows],
        )
        return after, goal.reward(state, after), ticks

    def check(
        self, steps: Sequence[Mapping[str, Any]], played: tuple[GoalState, Tensor, Tensor], tolerance: float
    ) -> None:
        """Assert that the recorded steps ended as these did."""
        after, reward, ticks = played
        bodies = torch.stack(after[: len(rules.COLUMNS)])
        expected = torch.stack(self.bodies([step["state"] for step in steps]))
        for name, got, recorded in (
            ("state", bodies, expected),
            ("observation", goal.observe(after, is_scaled=False), self.tensor([s["observation"] for s in steps])),
            ("reward", reward, self.tensor([step["reward"] for step in steps])),
        ):
            torch.testing.assert_close(got, recorded, rtol=0.0, atol=tolerance, msg=lambda text, n=name: f"{n}: {text}")
        assert ticks.tolist() == [step["ticks"] for step in steps]
        assert after.steps.tolist() == [step["state"][-1] for step in steps]
        assert after.outcome.tolist() == [OUTCOME_CODES[step["outcome"]] for step in steps]
        flags = [(step["terminated"], step["truncated"]) for step in steps]
        is_late = after.outcome == rules.TIME_LIMIT
        is_over = after.outcome != rules.PLAYING
        assert list(zip((is_over & ~is_late).tolist(), is_late.tolist(), strict=True)) == flags


@pytest.mark.parametrize("domain", DOMAINS)
def test_recorded_episodes_are_played_through_to_the_last_digit(domain):
    trace = Trace(domain, torch.float64)
    episodes = trace.episodes
    state = trace.state([episode["initial"]["state"] for episode in episodes])
    scaled = trace.tensor([episode["initial"]["scaled_observation"] for episode in episodes])
    torch.testing.assert_close(goal.observe(state), scaled, rtol=0.0, atol=1e-9)
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
    bodies = goal.tick(trace.bodies(before), aim.x, aim.y, trace.tensor(draws).T)
    torch.testing.assert_close(torch.stack(bodies), torch.stack(trace.bodies(after)), rtol=0.0, atol=1e-9)
    assert len(after) > 50


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
