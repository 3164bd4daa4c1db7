"""The closed forms of a press agree with a simulation in small time steps and have the symmetries of the task."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.physics import OUT_OF_BOUNDS, OUT_OF_FUEL, SAILING, SUCCESS, TOO_FAST

NUM_STEPS = 20_000
EACH = settings(deadline=None, max_examples=50, derandomize=True)


class Case(NamedTuple):
    """A press to make; px from the harbour's centre, seconds, radians."""

    x: float
    y: float
    goal_x: float
    goal_y: float
    heading: float
    duration: float
    fuel: float
    strength: float = 1.0
    glide: float = 1.0


class Simulated(NamedTuple):
    """The result of a simulation; `margin` is the distance (px, px/s) from another outcome."""

    outcome: int
    travelled: float
    burnt: float
    margin: float


@st.composite
def cases(sample):
    """Sample boats anywhere in the harbour with a dock in any direction, about half of them heading for it."""
    radius = sample(st.floats(0, 118))
    angle = sample(st.floats(0, 2 * math.pi))
    x = radius * math.cos(angle)
    y = radius * math.sin(angle)
    distance = sample(st.floats(15.6, 200))
    bearing = sample(st.floats(0, 2 * math.pi))
    goal_x = x + distance * math.cos(bearing)
    goal_y = y + distance * math.sin(bearing)
    heading = bearing + sample(st.floats(-0.3, 0.3) | st.floats(-math.pi, math.pi))
    return Case(x, y, goal_x, goal_y, heading, sample(st.floats(0.1, 2)), sample(st.floats(0.05, 6)))


def press(batch: list[Case], function=physics.press) -> physics.Press:
    x, y, goal_x, goal_y, heading, duration, fuel, *boat = torch.tensor(batch, dtype=torch.float64).unbind(-1)
    columns = (x, y, fuel, goal_x, goal_y, heading.cos(), heading.sin(), duration)
    strength, glide = (column.to(torch.float32) for column in boat)
    return function(*(column.to(torch.float32) for column in columns), strength=strength, glide=glide)


def simulate(case: Case) -> Simulated:
    """Simulate one press in small time steps, given only its acceleration (NumPy, float64)."""
    pressed_for = min(case.duration, case.fuel)
    # In the glide the speed falls along the same curve, in 0.95 * glide times the time.
    dt = pressed_for / NUM_STEPS
    middle = (np.arange(NUM_STEPS) + 0.5) * dt
    rising = case.strength * (100.0 * middle**2 - 20.0 / 3.0 * middle**3)
    speeds = np.concatenate([rising, rising[::-1]])
    steps = np.concatenate([rising * dt, rising[::-1] * dt * 0.95 * case.glide])
    way = np.cumsum(steps)
    x = case.x + way * math.cos(case.heading)
    y = case.y + way * math.sin(case.heading)
    to_dock = np.hypot(x - case.goal_x, y - case.goal_y) - 15.0
    to_rim = 120.0 - np.hypot(x, y)
    docked, left = (np.flatnonzero(gap <= 0.0) for gap in (to_dock, to_rim))
    first_docked, first_left = (hits[0] if len(hits) else 2 * NUM_STEPS for hits in (docked, left))
    step = min(first_docked, first_left, 2 * NUM_STEPS - 1)
    burnt = min(step * dt, pressed_for)
    if first_docked < first_left:
        margin = min(abs(speeds[step] - 74.0), -to_dock.min(), abs(way[step] - way[-1]))
        return Simulated(SUCCESS if speeds[step] <= 74.0 else TOO_FAST, way[step], burnt, margin)
    if first_left < 2 * NUM_STEPS:
        return Simulated(OUT_OF_BOUNDS, way[step], burnt, min(to_dock[:step].min(initial=1.0), -to_rim.min()))
    outcome = OUT_OF_FUEL if case.fuel <= case.duration else SAILING
    return Simulated(outcome, way[-1], burnt, min(to_dock.min(), to_rim.min(), abs(case.fuel - case.duration)))


def assert_agrees(case: Case, expected: Simulated) -> None:
    after = press([case])
    assert after.outcome.item() == expected.outcome
    travelled = math.hypot(after.x.item() - case.x, after.y.item() - case.y)
    assert travelled == pytest.approx(expected.travelled, abs=0.1)
    assert case.fuel - after.fuel.item() == pytest.approx(expected.burnt, abs=2e-3)


@pytest.mark.parametrize("has_other_boats", [False, True])
def test_small_time_steps_agree_on_many_presses_of_every_outcome_also_with_other_strength_and_glide(has_other_boats):
    rng = np.random.default_rng(int(has_other_boats))
    met = dict.fromkeys((SAILING, SUCCESS, TOO_FAST, OUT_OF_BOUNDS, *([] if has_other_boats else [OUT_OF_FUEL])), 0)
    for _ in range(150 if has_other_boats else 300):
        x, y, goal_x, goal_y = rng.uniform(-75.0, 75.0, 4)
        if math.hypot(goal_x - x, goal_y - y) < 15.5:
            continue
        heading = math.atan2(goal_y - y, goal_x - x) + rng.normal(0.0, 0.4)
        duration = rng.uniform(0.3, 1.6)
        boat = (6.0, *rng.uniform(0.5, 2.0, 2)) if has_other_boats else (rng.uniform(0.3, 4.0),)
        case = Case(x, y, goal_x, goal_y, heading, duration, *boat)
        expected = simulate(case)
        if expected.margin > 0.1:
            assert_agrees(case, expected)
            met[expected.outcome] += 1
    assert min(met.values()) >= 10, met


def test_strength_and_glide_change_the_way_and_the_time_of_a_press_alike():
    time = torch.linspace(0.0, 1.2, 20_001, dtype=torch.float64)
    press_time = torch.tensor(0.7, dtype=torch.float64)
    way = physics.distance_at(press_time, time, strength=1.3, glide=0.7)
    virtual = torch.where(time <= 0.7, time, 0.7 - (time - 0.7) / (0.7 * physics.GLIDE)).clamp(min=0.0)
    expected = torch.cumulative_trapezoid(1.3 * physics.speed(virtual), time)
    torch.testing.assert_close(way[1:], expected, atol=1e-5, rtol=0.0)
    sailing = (time > 0.01) & (time < 1.16)
    again = physics.time_at(press_time, way, strength=1.3, glide=0.7)
    torch.testing.assert_close(again[sailing], time[sailing], atol=1e-5, rtol=0.0)


@EACH
@given(st.lists(cases(), min_size=20, max_size=20))
def test_the_boat_stops_on_the_circle_that_it_met(batch):
    after = press(batch)
    goal_x, goal_y = torch.tensor([[case.goal_x, case.goal_y] for case in batch]).unbind(-1)
    from_goal = torch.hypot(after.x - goal_x, after.y - goal_y)
    from_centre = torch.hypot(after.x, after.y)
    docks = (after.outcome == SUCCESS) | (after.outcome == TOO_FAST)
    leaves = after.outcome == OUT_OF_BOUNDS
    assert (from_goal[docks] - physics.DOCK_RADIUS).abs().lt(1e-3).all()
    assert (from_centre[leaves] - physics.HARBOUR_RADIUS).abs().lt(1e-3).all()
    assert from_goal[~docks].gt(physics.DOCK_RADIUS - 1e-3).all()
    assert from_centre.lt(physics.HARBOUR_RADIUS + 1e-3).all()


@EACH
@given(st.lists(cases(), min_size=20, max_size=20))
def test_fuel_never_rises_and_falls_by_at_most_the_duration_and_never_below_zero(batch):
    after = press(batch)
    fuel, duration = (torch.tensor([getattr(case, name) for case in batch]) for name in ("fuel", "duration"))
    assert (after.fuel >= 0.0).all()
    assert (after.fuel <= fuel).all()
    assert (fuel - after.fuel <= duration + 1e-5).all()


@EACH
@given(st.floats(20, 220), st.floats(5, 300))
def test_an_arrival_docks_at_up_to_74_px_a_second_and_is_too_fast_above(distance, arrival):
    assume(abs(arrival - 74.0) > 0.01)
    time = torch.linspace(0.0, 2.0, 200_001, dtype=torch.float64)
    left = time[(physics.speed(time) < arrival).sum()]
    glide_left = 0.95 * physics.pressed_distance(left)
    duration = physics.duration_for((distance - 15.0 + glide_left) / 1.95).item()
    assume(left < duration < 2.0)
    after = press([Case(-110.0, 0.0, distance - 110.0, 0.0, 0.0, duration, 6.0)])
    assert after.outcome.item() == (SUCCESS if arrival <= 74.0 else TOO_FAST)


@pytest.mark.parametrize(("speed", "outcome"), [(73.9, SUCCESS), (74.1, TOO_FAST)])
def test_the_docking_speed_also_holds_while_the_key_is_still_down(speed, outcome):
    time = torch.linspace(0.0, 2.0, 200_001, dtype=torch.float64)
    contact = time[(physics.speed(time) < speed).sum()]
    gap = physics.pressed_distance(contact).item()
    after = press([Case(0.0, 0.0, gap + 15.0, 0.0, 0.0, 2.0, 6.0)])
    assert after.outcome.item() == outcome
    assert 6.0 - after.fuel.item() == pytest.approx(contact.item(), abs=1e-4)
    assert after.speed.item() == pytest.approx(speed, abs=0.05)


def test_duration_for_inverts_the_pressed_distance():
    distance = physics.pressed_distance(torch.linspace(0.0, 2.0, 20_001))
    assert (physics.pressed_distance(physics.duration_for(distance)) - distance).abs().max() < 1e-3
    whole = physics.total_distance(physics.press_for(distance))
    assert (whole - distance).abs().max() < 1e-3


def test_the_distance_is_the_integral_of_the_measured_speed():
    time = torch.linspace(0.0, 2.0, 101, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(physics.pressed_distance(time).sum(), time)
    torch.testing.assert_close(slope, physics.speed(time))
    assert physics.speed(torch.tensor(1.0)).item() == pytest.approx(100.0 - 20.0 / 3.0)
    assert physics.pressed_distance(torch.tensor(0.0)).item() == 0.0


@EACH
@given(st.lists(cases(), min_size=20, max_size=20))
def test_turning_the_world_by_180_degrees_and_swapping_the_controller_turns_the_result(batch):
    x, y, goal_x, goal_y, _, duration, fuel, *_ = torch.tensor(batch).unbind(-1)
    key = torch.arange(len(batch)) % 3
    # For each key of the incongruent controller, with key map 1 and 2, the opposite key of the congruent controller.
    opposite = torch.tensor([[0, 2, 1], [1, 0, 2]])
    for keymap in (1, 2):
        maps = torch.full_like(key, keymap)
        ours = harbour.direction(torch.full_like(key, harbour.INCONGRUENT), maps, key)
        theirs = harbour.direction(torch.full_like(key, harbour.CONGRUENT), maps, opposite[keymap - 1][key])
        after = physics.press(x, y, fuel, goal_x, goal_y, *ours, duration)
        turned = physics.press(-x, -y, fuel, -goal_x, -goal_y, *theirs, duration)
        expected = after._replace(x=-after.x, y=-after.y)
        for mine, other in zip(turned, expected, strict=True):
            torch.testing.assert_close(mine, other, atol=1e-4, rtol=0.0)


@EACH
@given(st.lists(cases(), min_size=5, max_size=20))
def test_a_boat_moves_in_a_batch_as_it_does_alone(batch):
    together = press(batch)
    for row, case in enumerate(batch):
        for one, many in zip(press([case]), together, strict=True):
            torch.testing.assert_close(one, many[row : row + 1], atol=1e-4, rtol=1e-5)


@EACH
@given(cases())
def test_a_press_ends_when_the_tank_runs_dry(case):
    case = case._replace(fuel=case.duration * 0.5)
    long, exact = press([case]), press([case._replace(duration=case.fuel)])
    assert all(torch.equal(a, b) for a, b in zip(long, exact, strict=True))
    if long.outcome.item() in (SAILING, OUT_OF_FUEL):
        assert long.outcome.item() == OUT_OF_FUEL
        assert long.fuel.item() == 0.0


def test_a_press_of_no_duration_changes_nothing():
    after = press([Case(10.0, -20.0, 60.0, 30.0, 1.0, 0.0, 4.0)])
    assert torch.stack([after.x, after.y, after.fuel, after.speed]).flatten().tolist() == [10.0, -20.0, 4.0, 0.0]
    assert after.outcome.item() == SAILING
