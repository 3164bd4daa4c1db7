"""ReleasedBoatDockEnv follows the released code's rules, to the last digit of its recorded episodes."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from released_players import (
    DISTANCE,
    FUEL,
    IDLE,
    RECORDED,
    STEP,
    TRACES,
    VELOCITY,
    X,
    Y,
    action,
    end,
    layouts,
    load_replay,
    observed,
    one,
    place,
    press,
)

from hpamdp import keys
from hpamdp.env.boatdock_released import rules as released
from hpamdp.env.boatdock_released.environment import ReleasedBoatDockEnv
from hpamdp.env.boatdock_released.rules import OUT_OF_FUEL, SAILING, SUCCESS, TIME_LIMIT, WALL


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-12), ("float32", 1e-5)])
def test_a_recorded_episode_is_reproduced(dtype, tolerance):
    steps, difference = load_replay().replay([RECORDED], dtype)
    assert steps == 4 and difference < tolerance


@pytest.mark.parametrize("change", [{"success": True}, {"reward": math.nan}], ids=str)
def test_the_replay_finds_a_wrong_flag_and_a_nan(change):
    other = json.loads(json.dumps(RECORDED))
    other["steps"][1].update(change)
    assert load_replay().replay([other])[1] == math.inf


@pytest.mark.skipif(not TRACES, reason="HPAMDP_TRACES names no folder with traces")
@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-9), ("float32", 1e-3)])
def test_every_recorded_trace_is_reproduced(dtype, tolerance):
    for file in TRACES:
        episodes = json.loads(file.read_text())
        steps, difference = load_replay().replay(episodes, dtype)
        assert steps == sum(len(episode["steps"]) for episode in episodes) > 0
        assert difference < tolerance, file.stem


@pytest.mark.parametrize(("seconds", "px"), [(0.1, 33.333), (0.2, 66.66), (0.31, -16.0415), (5.0, -1_958_437.5)])
def test_a_press_of_more_than_three_tenths_of_a_second_moves_the_boat_backwards(seconds, px):
    assert released.reach(torch.tensor(seconds, dtype=torch.float64)).item() == pytest.approx(px, rel=1e-3)


@pytest.mark.parametrize(
    ("controller", "keymap", "expected"),
    [
        ("congruent", None, [(-0.866, 0.5), (0.0, -1.0), (0.866, 0.5)]),
        ("incongruent", 1, [(0.866, -0.5), (-0.866, -0.5), (0.0, 1.0)]),
        ("incongruent", 0, [(0.0, 1.0), (0.866, -0.5), (-0.866, -0.5)]),
    ],
)
def test_keys_push_where_the_key_map_says(controller, keymap, expected):
    env = one(controller=controller)
    for key, (x, y) in enumerate(expected):
        given = {} if keymap is None else {"keymap": keymap}
        place(env, (640.0, 512.0), (600.0, 440.0), **given)
        after = observed(press(env, key, -0.96))
        assert (after[X] - 640.0, after[Y] - 512.0) == pytest.approx((33.333 * x, 33.333 * y), abs=1e-3)
        assert after[VELOCITY] == pytest.approx([x, y], abs=1e-6)  # 10 x .1 s
        assert after[7:9] == [float(controller == "congruent"), -1 if keymap is None else keymap]


def test_durations_outside_their_bounds_are_clipped():
    results = []
    for duration in (-1.0, -1.5):
        env = one()
        place(env, (640.0, 512.0), (600.0, 440.0))
        results.append(observed(press(env, 0, duration)))
    assert results[0] == results[1]


def test_the_duration_is_rounded_as_float32_whatever_the_dtype_of_the_rest():
    u = np.float32(0.1234567)
    env = one()
    place(env, (640.0, 512.0), (600.0, 440.0))
    speed = -observed(press(env, 1, float(u)))[12]
    assert speed == 10.0 * float((u + np.float32(1)) / np.float32(2) * np.float32(5))
    assert speed != 10.0 * 2.5 * (float(u) + 1.0)


def test_idling_at_minus_one_refuels_without_limit_and_success_rewards_the_fuel():
    env = one()
    place(env, (640.0, 512.0), (640.0, 440.0))
    for idle in range(1, 401):
        td = press(env, 1, IDLE)
        assert observed(td)[FUEL] == pytest.approx(1.0 + idle / 5.0)
        assert td[keys.REWARD].item() == 0.0
    outcome, reward, terminated, truncated = end(press(env, 1, STEP))
    assert (outcome, terminated, truncated) == (SUCCESS, True, False)
    assert reward == pytest.approx(2.0 * (5.0 + 400.0 + 0.92))


def test_the_reward_before_the_end_is_the_decrease_of_the_distance_as_a_fraction_of_that_at_the_start():
    env = one()
    place(env, (640.0, 570.0), (640.0, 450.0))
    outcome, reward, *flags = end(press(env, 1, -0.96))
    assert (outcome, flags) == (SAILING, [False, False])
    assert reward == pytest.approx(33.333 / 120.0, abs=1e-4)


def set_fuel_and_steps(env: ReleasedBoatDockEnv, fuel: float, steps: int) -> None:
    state = env.env_state()
    state["fuel"] = torch.tensor([fuel], dtype=torch.float64)
    state["steps"] = torch.tensor([steps])
    env.set_env_state(state)


@pytest.mark.parametrize(
    ("start", "key", "duration", "fuel", "steps", "expected"),
    [
        ((640.0, 512.0), 1, STEP, 5.0, 0, SUCCESS),
        ((640.0, 480.0), 1, STEP, 5.0, 0, WALL),  # the dock reaches up to the wall
        ((640.0, 480.0), 1, STEP, -0.92, 0, OUT_OF_FUEL),
        ((640.0, 512.0), 1, STEP, -0.92 + 5e-7, 0, OUT_OF_FUEL),
        ((640.0, 480.0), 1, STEP, -0.92, 998, TIME_LIMIT),
        ((640.0, 512.0), 1, STEP, 5.0, 998, TIME_LIMIT),
        ((640.0, 512.0), 1, STEP, 5.0, 997, SUCCESS),
    ],
)
def test_where_several_outcomes_apply_the_time_limit_beats_fuel_beats_walls_beats_the_dock(
    start, key, duration, fuel, steps, expected
):
    env = one()
    place(env, start, (640.0, 440.0))
    set_fuel_and_steps(env, fuel, steps)
    outcome, reward, terminated, truncated = end(press(env, key, duration))
    assert outcome == expected
    assert reward == pytest.approx({SUCCESS: 2.0 * (fuel + 0.92), OUT_OF_FUEL: -1.0}.get(expected, 0.0))
    assert (terminated, truncated) == (expected != TIME_LIMIT, expected == TIME_LIMIT)


@pytest.mark.parametrize(
    ("name", "start", "key", "expected"),
    [
        ("left", (580.0, 500.0), 0, WALL),
        ("upper", (640.0, 450.0), 1, WALL),
        ("right", (700.0, 500.0), 2, SAILING),
        ("lower", (640.0, 570.0), 2, SAILING),
    ],
)
def test_the_left_and_upper_walls_end_the_episode_with_reward_0_and_the_others_do_not(name, start, key, expected):
    env = one()
    place(env, start, (640.0, 512.0))
    td = press(env, key, STEP)
    assert td[keys.OUTCOME].item() == expected
    shown = observed(td)
    if expected == WALL:
        assert td[keys.REWARD].item() == 0.0
        assert tuple(shown[X : Y + 1]) == start and shown[DISTANCE] == 1.0
    else:
        assert shown[X] == 707.0 if name == "right" else shown[Y] == 579.0


def test_a_start_out_of_bounds_is_shown_as_it_is_but_the_first_move_starts_within_bounds():
    env = one()
    td = place(env, (715.0, 588.0), (640.0, 440.0))
    assert observed(td)[X : Y + 1] == [715.0, 588.0]
    after = observed(press(env, 1, IDLE))
    assert after[X : Y + 1] == [707.0, 579.0]


def test_the_goal_is_clamped_for_the_dock_but_not_for_the_distance():
    env = one()
    place(env, (640.0, 512.0), (715.0, 555.0))
    # A press to (698, 545.5): within 10 px of (707, 555), but not of the goal itself.
    outcome, reward, *_ = end(press(env, 2, -0.9196))
    assert outcome == SUCCESS and reward > 10.0
    assert observed(env.step(action([2], [IDLE]))["next"])[DISTANCE] == 1.0
    place(env, (640.0, 512.0), (715.0, 588.0))
    after = observed(press(env, 2, -0.96))
    expected = math.hypot(715.0 - after[X], 588.0 - after[Y]) / math.hypot(75.0, 76.0)
    assert after[DISTANCE] == pytest.approx(expected)


def test_a_reset_keeps_the_velocity_but_resets_fuel_and_position():
    env = one()
    place(env, (640.0, 512.0), (640.0, 440.0))
    before = observed(press(env, 2, -0.96))
    again = observed(env.reset())
    assert again[VELOCITY] == before[VELOCITY] != [0.0, 0.0]
    assert again[X:11] == [640.0, 512.0] and again[FUEL:] == [1.0, 1.0]


def test_the_time_limit_is_the_999th_step():
    env = one()
    env.reset()
    for _ in range(998):
        assert not press(env, 0, IDLE)[keys.DONE].item()
    assert end(press(env, 0, IDLE)) == (TIME_LIMIT, 0.0, False, True)


def test_layouts_are_frozen_for_life_by_default_and_new_each_episode_otherwise():
    frozen, fresh = ReleasedBoatDockEnv(50), ReleasedBoatDockEnv(50, frozen_layouts=False)
    first = layouts(frozen.reset())
    assert (layouts(frozen.reset()) == first).all()
    assert len(first.unique(dim=0)) == 50
    assert (layouts(fresh.reset()) == first).all()
    assert (layouts(fresh.reset()) != first).any(-1).all()
    assert (layouts(frozen.reset(frozen.fixed_episodes(0))) != first).any(-1).all()
    assert (layouts(frozen.reset()) == layouts(frozen.reset(frozen.fixed_episodes(0)))).all()


def test_layouts_stay_frozen_past_the_largest_number_of_an_episode():
    env = ReleasedBoatDockEnv(5)
    first = layouts(env.reset())
    env.state = env.state._replace(episode=torch.full((5,), 2**31 - 1, dtype=torch.int32))
    assert all((layouts(env.reset()) == first).all() for _ in range(2))


def test_key_map_zero_is_sampled_again_at_every_reset_until_it_is_one():
    env = ReleasedBoatDockEnv(400, controller="incongruent")
    last = torch.zeros(400)
    shares = []
    for _ in range(4):
        keymap = env.reset()[keys.OBSERVATION][:, 8]
        assert (keymap >= last).all()
        shares.append(keymap.mean().item())
        last = keymap
    assert shares == pytest.approx([0.5, 0.75, 0.875, 0.9375], abs=0.07)
    for arguments, expected in (({"controller": "incongruent", "keymap": 1}, 1), ({"controller": "congruent"}, -1)):
        env = ReleasedBoatDockEnv(50, **arguments)
        assert (env.reset()[keys.OBSERVATION][:, 8] == expected).all()


@pytest.mark.parametrize("test_mode", [None, 0, 1])
def test_layouts_are_whole_pixels_far_enough_apart_and_of_their_test_mode(test_mode):
    env = ReleasedBoatDockEnv(2_000, test_mode=test_mode)
    for points in (layouts(env.reset()), torch.cat(list(env.fixed_episodes(3).values()), -1)):
        assert (points == points.round()).all()
        for axis, low in enumerate((563, 435) * 2):
            assert (points[:, axis].min().item(), points[:, axis].max().item()) == (low, low + 153)
        assert ((points[:, :2] - points[:, 2:]).norm(dim=-1) >= 100.0).all()
        within = torch.tensor([is_test_layout(*layout) for layout in points.tolist()]).float().mean().item()
        assert within == (pytest.approx(0.5, abs=0.1) if test_mode is None else test_mode)


def is_test_layout(*layout: float) -> bool:
    """Return whether the bearing between the clamped points is less than 30 degrees from 90, 210 or 330 (y down)."""
    x, y, goal_x, goal_y = (min(value, high) for value, high in zip(layout, (707, 579) * 2, strict=True))
    bearing = math.degrees(math.atan2(goal_y - y, goal_x - x))
    return abs((bearing - 90.0 + 60.0) % 120.0 - 60.0) < 30.0 - 1e-9
