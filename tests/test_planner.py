"""The planner's plans reach their scores in the simulator.

That no plan found by other means beats them is shown in test_boats and test_boatdock_unseen_planner.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from hpamdp.env.boatdock import physics
from hpamdp.env.boatdock.harbour import (
    CONGRUENT,
    INCONGRUENT,
    Layout,
    bearing_offset,
    direction,
    fixed_layouts,
    fuel_fraction,
)
from hpamdp.env.boatdock.harbour import score as score_of
from hpamdp.env.boatdock.planner import Plan, best_plan, best_plans, better_option

NUM = 400


def filled(value: int, num: int) -> Tensor:
    return torch.full((num,), value, dtype=torch.int32)


def full_tank(num: int) -> Tensor:
    return torch.full((num,), physics.TANK)


def replay(boat: tuple[Tensor, ...], keys: Tensor, durations: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Press the keys of a plan one after another; return outcome, score and number of presses made, each `[*B]`.

    `boat` has the arguments of `best_plan`: x, y, goal x, goal y, fuel, controller, keymap. A plan that has not docked
    after its last press scores -1.
    """
    x, y, goal_x, goal_y, fuel, controller, keymap = boat
    outcome = torch.full(x.shape, physics.SAILING, dtype=torch.int32)
    presses = torch.zeros(x.shape, dtype=torch.int64)
    for key, duration in zip(keys.unbind(-1), durations.unbind(-1), strict=True):
        sailing = (outcome == physics.SAILING) & (duration > 0.0)
        after = physics.press(x, y, fuel, goal_x, goal_y, *direction(controller, keymap, key), duration)
        x = torch.where(sailing, after.x, x)
        y = torch.where(sailing, after.y, y)
        fuel = torch.where(sailing, after.fuel, fuel)
        outcome = torch.where(sailing, after.outcome, outcome)
        presses = presses + sailing
    return outcome, score_of(outcome, fuel_fraction(fuel)), presses


def assert_docks_as_planned(boat: tuple[Tensor, ...], plan: Plan) -> None:
    """Assert that every plan docks, with the planned number of presses and the planned score."""
    outcome, score, presses = replay(boat, plan.keys, plan.durations)
    assert (outcome == physics.SUCCESS).all()
    assert torch.equal(presses, plan.num_presses)
    torch.testing.assert_close(score, plan.score, atol=1e-3, rtol=0.0)


def at_start(layout: Layout, controller: int, keymap: int = 1) -> tuple[Tensor, ...]:
    num = len(layout.start_x)
    return (*layout, full_tank(num), filled(controller, num), filled(keymap, num))


def with_controller(plans: Plan, controller: int) -> Plan:
    return Plan(*(field[:, controller] for field in plans))


@pytest.fixture(scope="module")
def layout() -> Layout:
    return fixed_layouts(NUM, seed=1)


@pytest.fixture(scope="module")
def plans(layout: Layout) -> Plan:
    return best_plans(layout, filled(1, NUM))


@pytest.mark.parametrize("controller", [INCONGRUENT, CONGRUENT])
def test_a_replayed_plan_docks_with_the_planned_score(layout: Layout, plans: Plan, controller: int) -> None:
    assert_docks_as_planned(at_start(layout, controller), with_controller(plans, controller))


def test_the_second_key_map_changes_keys_but_no_score(layout: Layout, plans: Plan) -> None:
    other = best_plans(layout, filled(2, NUM))
    torch.testing.assert_close(other.score, plans.score, atol=1e-3, rtol=0.0)
    assert_docks_as_planned(at_start(layout, INCONGRUENT, keymap=2), with_controller(other, INCONGRUENT))
    assert not torch.equal(other.keys[:, INCONGRUENT], plans.keys[:, INCONGRUENT])


def test_consecutive_presses_use_different_keys(plans: Plan) -> None:
    repeated = plans.keys[..., 1:] == plans.keys[..., :-1]
    assert not (repeated & (plans.durations[..., 1:] > 0.0)).any()


@pytest.mark.slow
def test_the_mean_ceiling_has_its_documented_values() -> None:
    score = best_plans(fixed_layouts(2000, seed=0), filled(1, 2000)).score
    assert score[:, CONGRUENT].mean().item() == pytest.approx(3.42, abs=0.03)
    assert score[:, INCONGRUENT].mean().item() == pytest.approx(3.41, abs=0.03)
    assert score.amax(1).mean().item() == pytest.approx(3.64, abs=0.03)


def test_the_boat_with_a_key_towards_the_goal_is_the_better_one(layout: Layout, plans: Plan) -> None:
    offset = bearing_offset(layout)
    better = better_option(plans)
    assert (better[offset < 15.0] == CONGRUENT).float().mean() > 0.95
    assert (better[offset > 45.0] == INCONGRUENT).float().mean() > 0.95
    assert torch.equal(plans.score.gather(1, better[:, None]).squeeze(1), plans.score.amax(1))


def test_two_presses_leave_a_few_layouts_unsolved_and_three_leave_none(layout: Layout, plans: Plan) -> None:
    two = best_plan(*at_start(layout, CONGRUENT), max_presses=2)
    assert (two.num_presses == 0).float().mean().item() == pytest.approx(0.026, abs=0.015)
    assert (plans.num_presses > 0).all()


def test_fewer_presses_never_score_higher(layout: Layout, plans: Plan) -> None:
    boat = at_start(layout, INCONGRUENT)
    one, two = best_plan(*boat, max_presses=1), best_plan(*boat, max_presses=2)
    assert one.num_presses.max() == 1 and two.num_presses.max() == 2
    assert (one.score <= two.score + 1e-6).all()
    # The search may refine another local minimum, which differs by some ten-thousandths.
    assert (two.score <= plans.score[:, INCONGRUENT] + 1e-3).all()


def test_without_enough_fuel_there_is_no_plan(layout: Layout, plans: Plan) -> None:
    x, y, goal_x, goal_y, fuel, controller, keymap = (field[:200] for field in at_start(layout, CONGRUENT))
    needed = fuel * (1.0 - plans.score[:200, CONGRUENT] / 5.0)
    short = best_plan(x, y, goal_x, goal_y, needed - 0.01, controller, keymap)
    assert (short.score == -1.0).all()
    assert not short.num_presses.any() and not short.keys.any() and not short.durations.any()
    just_enough = (x, y, goal_x, goal_y, needed + 1e-4, controller, keymap)
    assert_docks_as_planned(just_enough, best_plan(*just_enough))


def test_plans_can_start_in_the_middle_of_an_episode(layout: Layout) -> None:
    generator = torch.Generator().manual_seed(0)
    controller = torch.randint(2, (NUM,), generator=generator)
    keymap = 1 + torch.randint(2, (NUM,), generator=generator)
    key = torch.randint(3, (NUM,), generator=generator)
    length = 100.0 * torch.rand(NUM, generator=generator)
    direction_x, direction_y = direction(controller, keymap, key)
    goal = layout.goal_x, layout.goal_y
    start = layout.start_x, layout.start_y, full_tank(NUM), *goal, direction_x, direction_y
    after = physics.press(*start, physics.press_for(length))
    sailing = after.outcome == physics.SAILING
    assert sailing.sum() > NUM / 2
    boat = tuple(field[sailing] for field in (after.x, after.y, *goal, after.fuel, controller, keymap))
    plan = best_plan(*boat)
    assert (plan.num_presses > 0).all()
    assert_docks_as_planned(boat, plan)


def rotated(layout: Layout, degrees: float) -> Layout:
    angle = torch.deg2rad(torch.tensor(degrees))
    cos, sin = angle.cos(), angle.sin()
    start_x, start_y, goal_x, goal_y = layout
    return Layout(
        cos * start_x - sin * start_y,
        sin * start_x + cos * start_y,
        cos * goal_x - sin * goal_y,
        sin * goal_x + cos * goal_y,
    )


@pytest.mark.parametrize(
    ("image", "swapped"),
    [
        pytest.param(lambda layout: rotated(layout, 120.0), False, id="rotated by 120 degrees"),
        pytest.param(lambda layout: rotated(layout, 180.0), True, id="rotated by 180 degrees"),
        pytest.param(
            lambda layout: layout._replace(start_x=-layout.start_x, goal_x=-layout.goal_x), False, id="mirrored"
        ),
    ],
)
def test_the_scores_have_the_symmetries_of_the_keys(layout: Layout, plans: Plan, image, swapped: bool) -> None:
    score = best_plans(Layout(*(field[:400] for field in image(layout))), filled(1, 400)).score
    expected = plans.score[:400].flip(1) if swapped else plans.score[:400]
    torch.testing.assert_close(score, expected, atol=2e-3, rtol=0.0)


def test_a_boat_gets_the_same_plan_in_any_batch(layout: Layout, plans: Plan) -> None:
    part = best_plans(Layout(*(field[90:101] for field in layout)), filled(1, 11))
    for field, whole in zip(part, plans, strict=True):
        torch.testing.assert_close(field, whole[90:101])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_plans_on_the_gpu_have_the_same_scores(layout: Layout, plans: Plan) -> None:
    on_gpu = best_plans(Layout(*(field.cuda() for field in layout)), filled(1, NUM).cuda())
    torch.testing.assert_close(on_gpu.score.cpu(), plans.score, atol=2e-3, rtol=0.0)
