"""Plans for boats of any directions, strength and glide reach their scores, and random presses never beat them."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from hpamdp.env.boatdock import physics, planner
from hpamdp.env.boatdock.harbour import CONGRUENT, Layout, direction, fixed_layouts, fuel_fraction, score_of
from hpamdp.env.boatdock_unseen.planner import best_plan

NUM = 200
SHORTEST = 0.15  # seconds


def drawn_boats(num: int, seed: int, spread: float = 0.3) -> tuple[Tensor, Tensor, Tensor]:
    """Return directions at any angles, at least 60 degrees apart, strength and glide."""
    generator = torch.Generator().manual_seed(seed)
    low, high = torch.rand(num, 2, generator=generator).sort(1).values.unbind(1)
    gaps = math.pi / 3.0 * torch.stack([0.0 * low, 1.0 + 3.0 * low, 2.0 + 3.0 * high], 1)
    angles = 2.0 * math.pi * torch.rand(num, 1, generator=generator) + gaps
    strength, glide = 1.0 + spread * (2.0 * torch.rand(2, num, generator=generator) - 1.0)
    return torch.stack([angles.cos(), angles.sin()], -1), strength, glide


def at_start(layout: Layout) -> tuple[Tensor, ...]:
    return *layout, torch.full_like(layout.start_x, physics.TANK)


def replay(layout: Layout, boats: tuple[Tensor, Tensor, Tensor], keys: Tensor, durations: Tensor) -> Tensor:
    """Return the scores `[N, S]` of S sequences of presses `[N, S, P]` for every layout, -1 if they do not dock."""
    directions, *factors = boats
    goal_x, goal_y = layout.goal_x[:, None], layout.goal_y[:, None]
    strength, glide = (factor[:, None] for factor in factors)
    shape = keys.shape[:2]
    x, y = (place[:, None].expand(shape) for place in layout[:2])
    fuel = torch.full(shape, physics.TANK)
    outcome = torch.full(shape, physics.SAILING, dtype=torch.int32)
    rows = torch.arange(len(keys))[:, None]
    for key, duration in zip(keys.unbind(-1), durations.unbind(-1), strict=True):
        push = directions[rows, key].unbind(-1)
        after = physics.press(x, y, fuel, goal_x, goal_y, *push, duration, strength=strength, glide=glide)
        sailing = (outcome == physics.SAILING) & (duration > 0.0)
        columns = zip((after.x, after.y, after.fuel, after.outcome), (x, y, fuel, outcome), strict=True)
        x, y, fuel, outcome = (torch.where(sailing, new, old) for new, old in columns)
    return score_of(outcome == physics.SUCCESS, fuel_fraction(fuel))


@pytest.fixture(scope="module")
def layout() -> Layout:
    return fixed_layouts(NUM, seed=4)


@pytest.fixture(scope="module")
def boats() -> tuple[Tensor, Tensor, Tensor]:
    return drawn_boats(NUM, seed=0)


@pytest.mark.parametrize("shortest_press", [0.0, SHORTEST])
@pytest.mark.parametrize("is_rough", [False, True])
def test_a_replayed_plan_docks_with_the_planned_score(layout, boats, shortest_press, is_rough):
    plan = best_plan(*at_start(layout), *boats, shortest_press=shortest_press, is_rough=is_rough)
    score = replay(layout, boats, plan.keys[:, None], plan.durations[:, None]).squeeze(1)
    torch.testing.assert_close(score, plan.score, atol=1e-3, rtol=0.0)
    assert torch.equal(plan.num_presses == 0, plan.score == -1.0)
    assert 0.6 < (plan.score > 0.0).float().mean() < 0.9  # some boats cannot push towards the dock


def test_every_press_of_a_plan_has_the_shortest_duration_or_more(layout, boats):
    plan = best_plan(*at_start(layout), *boats, shortest_press=0.4)
    pressed = plan.durations[plan.durations > 0.0]
    assert pressed.min().item() == pytest.approx(0.4)
    free = best_plan(*at_start(layout), *boats)
    assert (plan.score <= free.score + 1e-3).all()
    assert (free.durations[free.durations > 0.0] < 0.4).any()


def test_with_peoples_directions_the_plans_are_those_of_peoples_boats(layout):
    ones = torch.ones(NUM)
    controller, keymap = (torch.full((NUM,), value, dtype=torch.int32) for value in (CONGRUENT, 1))
    push = direction(controller[:, None], keymap[:, None], torch.arange(3))
    ours = best_plan(*at_start(layout), torch.stack(push, -1), ones, ones)
    theirs = planner.best_plan(*at_start(layout), controller, keymap)
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


@pytest.mark.parametrize("shortest_press", [0.0, SHORTEST])
def test_random_presses_improved_step_by_step_never_beat_the_plan(shortest_press):
    num, samples = 30, 4000
    layout, boats = fixed_layouts(num, seed=5), drawn_boats(num, seed=1)
    plan = best_plan(*at_start(layout), *boats, shortest_press=shortest_press)
    generator = torch.Generator().manual_seed(0)
    keys = torch.randint(3, (num, samples, 3), generator=generator)
    length = 200.0 * torch.rand(num, samples, 1, generator=generator) * torch.rand(keys.shape, generator=generator)
    absent = torch.rand(keys.shape, generator=generator) < 0.3
    durations = torch.where(absent, 0.0, physics.press_for(length).clamp(min=shortest_press))
    score, best = replay(layout, boats, keys, durations).topk(200, dim=1)
    keys, durations = (field.take_along_dim(best[..., None], 1) for field in (keys, durations))
    for width in torch.logspace(-1.0, -4.0, 60).tolist():
        noise = width * torch.randn(durations.shape, generator=generator)
        other = torch.where(durations > 0.0, (durations + noise).clamp(shortest_press, 2.0), 0.0)
        other_score = replay(layout, boats, keys, other)
        durations = torch.where((other_score > score)[..., None], other, durations)
        score = torch.maximum(score, other_score)
    excess = score.amax(1) - plan.score
    assert excess.max() < 5e-3
    assert excess.median() > -0.05  # the opponent is a fair one


def test_a_turned_harbour_and_boat_have_the_same_scores(layout, boats):
    angle = torch.tensor(0.7)
    turn = torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    start, goal = (turn @ torch.stack(point) for point in (layout[:2], layout[2:]))
    directions, strength, glide = boats
    turned = best_plan(*at_start(Layout(*start, *goal)), directions @ turn.T, strength, glide)
    torch.testing.assert_close(turned.score, best_plan(*at_start(layout), *boats).score, atol=3e-3, rtol=0.0)


def test_a_rough_plan_is_nearly_as_good(layout, boats):
    loss = best_plan(*at_start(layout), *boats).score - best_plan(*at_start(layout), *boats, is_rough=True).score
    assert loss.mean() < 0.01 and loss.min() > -1e-3


def test_a_shortest_press_that_is_too_fast_to_dock_is_refused(layout, boats):
    with pytest.raises(ValueError, match=r"shortest_press=1 s leads to .* at most 74 px/s dock"):
        best_plan(*at_start(layout), *boats, shortest_press=1.0)


def test_no_boats_have_no_plans(layout, boats):
    plan = best_plan(*(column[:0] for column in (*at_start(layout), *boats)))
    assert plan.keys.shape == (0, 3)
