"""ReleasedBoatDockEnv plays by the released code's rules, to the last digit of its recorded episodes."""

from __future__ import annotations

import importlib.util
import json
import math
import os
import random
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.env import released
from hpamdp.env.boatdock_released import ReleasedBoatDockEnv
from hpamdp.env.released import OUT_OF_FUEL, SAILING, SUCCESS, TIME_LIMIT, WALL
from hpamdp.reference import references

REPLAY = Path(__file__).resolve().parent.parent / "experiments" / "released" / "replay.py"
TRACES = sorted(Path(os.environ["HPAMDP_TRACES"]).glob("*.json")) if "HPAMDP_TRACES" in os.environ else []
IDLE, STEP = -1.0, -0.92  # no time at all; .2 s, which carry 66.65 px
X, Y = 9, 10
VELOCITY, FUEL, DISTANCE = slice(11, 13), 13, 14

# A recorded episode of the released code: key, parameter, boat, velocity, fuel, distance, reward; the last press docks.
HEAD = (693.0, 585.0, 611.0, 482.0, 640.0, 512.0, 120.0, 1.0, -1.0)
FIRST, SECOND, THIRD = (
    (693.0, 527.7580543433888),
    (662.0440020606039, 509.88507631833335),
    (629.2628408440448, 490.95830887228306),
)
PRESSES = (
    (1, -0.9449630379676819, FIRST, (0.0, -1.3759240508079529), 1.1889926075935364, 0.7132524008542312),
    (2, -0.8716713190078735, SECOND, (2.778315943479538, 1.6041085124015808), 1.363326871395111, 0.4417926346074991),
    (2, -0.8712390661239624, THIRD, (2.787674218416214, 1.60951167345047), 1.5375746846199037, 0.15450739546487646),
    (2, -0.8746877312660217, THIRD, (2.7130106180906295, 1.5664033591747284), 1.712512230873108, 0.15450739546487646),
)
REWARDS = (0.2867475991457688, 0.27145976624673207, 0.28728523914262266, 17.12512230873108)
RECORDED = {
    **{"controller": 1, "keymap": -1, "start": HEAD[:2], "goal": HEAD[2:4]},
    "observation0": (*HEAD, *HEAD[:2], 0.0, 0.0, 1.0, 1.0),
    "steps": [
        {
            **{"key": key, "parameter": (parameter,) * 3, "reward": reward},
            "observation": (*HEAD, *boat, *velocity, fuel, distance),
            **{"done": reward == REWARDS[-1], "truncated": False, "success": reward == REWARDS[-1]},
        }
        for (key, parameter, boat, velocity, fuel, distance), reward in zip(PRESSES, REWARDS, strict=True)
    ],
}


def load_replay():
    spec = importlib.util.spec_from_file_location("replay", REPLAY)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def action(key, duration) -> TensorDict:
    """Build an action: `key` a list, `duration` a number for each environment or `[N, 3]`."""
    key, duration = torch.as_tensor(key), torch.as_tensor(duration, dtype=torch.float32)
    duration = duration if duration.ndim == 2 else duration.unsqueeze(-1).expand(-1, 3)
    return TensorDict({keys.ACTION: TensorDict(key=key, duration=duration, batch_size=[len(key)])}, [len(key)])


def press(env: ReleasedBoatDockEnv, key: int, duration: float) -> TensorDict:
    return env.step(action([key] * env.num_envs, [duration] * env.num_envs))["next"]


def place(env: ReleasedBoatDockEnv, start, goal, **more) -> TensorDict:
    """Start one boat there."""
    layout = {"start": torch.tensor([start]).double(), "goal": torch.tensor([goal]).double()}
    return env.reset(TensorDict({**layout, **{name: torch.tensor([value]) for name, value in more.items()}}, [1]))


def seen(td: TensorDict) -> list[float]:
    return td[keys.OBSERVATION][0].tolist()


def end(td: TensorDict) -> tuple[int, float, bool, bool]:
    flags = [td[name].item() for name in (keys.TERMINATED, keys.TRUNCATED)]
    return (td[keys.OUTCOME].item(), td[keys.REWARD].item(), *flags)


def one(**arguments) -> ReleasedBoatDockEnv:
    return ReleasedBoatDockEnv(dtype="float64", **arguments)


def restart(env: ReleasedBoatDockEnv, td: TensorDict, rows: list[bool]) -> TensorDict:
    return env.reset(td.clone().set("_reset", torch.tensor(rows).unsqueeze(-1)))


@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-12), ("float32", 1e-5)])
def test_a_recorded_episode_is_reproduced(dtype, tolerance):
    steps, difference = load_replay().replay([RECORDED], dtype)
    assert steps == 4 and difference < tolerance


@pytest.mark.skipif(not TRACES, reason="HPAMDP_TRACES names no folder with traces")
@pytest.mark.parametrize(("dtype", "tolerance"), [("float64", 1e-9), ("float32", 1e-3)])
@pytest.mark.parametrize("file", TRACES, ids=lambda file: file.stem)
def test_every_recorded_trace_is_reproduced(file, dtype, tolerance):
    episodes = json.loads(file.read_text())
    steps, difference = load_replay().replay(episodes, dtype)
    assert steps == sum(len(episode["steps"]) for episode in episodes) > 0
    assert difference < tolerance


def test_replay_tells_the_same_from_another_and_from_no_trace_at_all(tmp_path, monkeypatch, capsys):
    other = json.loads(json.dumps(RECORDED))
    other["steps"][2]["reward"] += 1e-6
    for episodes, code in (([RECORDED], 0), ([RECORDED, other], 1), ({"a": 1}, 2), ([{"controller": 1}], 2), ([], 2)):
        file = tmp_path / "trace.json"
        file.write_text(json.dumps(episodes))
        monkeypatch.setattr("sys.argv", ["replay.py", str(file)])
        with pytest.raises(SystemExit) as exit_:
            load_replay().main()
        assert exit_.value.code == code
        assert len("".join(capsys.readouterr()).splitlines()) == 1


@pytest.mark.parametrize("change", [{"done": True}, {"success": True}, {"reward": math.nan}], ids=str)
def test_replay_finds_a_wrong_flag_and_a_number_that_is_none(change):
    other = json.loads(json.dumps(RECORDED))
    other["steps"][1].update(change)
    assert load_replay().replay([other])[1] == math.inf


@pytest.mark.parametrize(("seconds", "px"), [(0.1, 33.333), (0.2, 66.66), (0.31, -16.0415), (5.0, -1_958_437.5)])
def test_a_press_of_more_than_three_tenths_of_a_second_throws_the_boat_backwards(seconds, px):
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
        after = seen(press(env, key, -0.96))
        assert (after[X] - 640.0, after[Y] - 512.0) == pytest.approx((33.333 * x, 33.333 * y), abs=1e-3)
        assert after[VELOCITY] == pytest.approx([x, y], abs=1e-6)  # 10 x .1 s
        assert after[7:9] == [float(controller == "congruent"), -1 if keymap is None else keymap]


def test_durations_outside_their_bounds_are_clipped():
    results = []
    for duration in (-1.0, -1.5):
        env = one()
        place(env, (640.0, 512.0), (600.0, 440.0))
        results.append(seen(press(env, 0, duration)))
    assert results[0] == results[1]


def test_the_duration_is_rounded_as_float32_whatever_the_type_of_the_rest():
    u = np.float32(0.1234567)
    env = one()
    place(env, (640.0, 512.0), (600.0, 440.0))
    speed = -seen(press(env, 1, float(u)))[12]
    assert speed == 10.0 * float((u + np.float32(1)) / np.float32(2) * np.float32(5))
    assert speed != 10.0 * 2.5 * (float(u) + 1.0)


def test_idling_at_minus_one_refuels_without_limit_and_success_pays_for_it():
    env = one()
    place(env, (640.0, 512.0), (640.0, 440.0))
    for idle in range(1, 401):
        td = press(env, 1, IDLE)
        assert seen(td)[FUEL] == pytest.approx(1.0 + idle / 5.0)
        assert td[keys.REWARD].item() == 0.0
    outcome, reward, terminated, truncated = end(press(env, 1, STEP))
    assert (outcome, terminated, truncated) == (SUCCESS, True, False)
    assert reward == pytest.approx(2.0 * (5.0 + 400.0 + 0.92))


def test_the_reward_under_way_is_the_distance_covered_as_a_share_of_the_start_s():
    env = one()
    place(env, (640.0, 570.0), (640.0, 450.0))
    outcome, reward, *flags = end(press(env, 1, -0.96))
    assert (outcome, flags) == (SAILING, [False, False])
    assert reward == pytest.approx(33.333 / 120.0, abs=1e-4)


def with_fuel(env: ReleasedBoatDockEnv, fuel: float, **more) -> None:
    columns = {"fuel": torch.tensor([fuel]).double(), **more}
    env.set_state_columns({**env.state_columns(), **columns})


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
def test_time_limit_comes_before_fuel_before_walls_before_the_dock(start, key, duration, fuel, steps, expected):
    env = one()
    place(env, start, (640.0, 440.0))
    with_fuel(env, fuel, steps=torch.tensor([steps]))
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
def test_two_walls_end_the_episode_for_nothing_and_two_are_free(name, start, key, expected):
    env = one()
    place(env, start, (640.0, 512.0))
    td = press(env, key, STEP)
    assert td[keys.OUTCOME].item() == expected
    shown = seen(td)
    if expected == WALL:
        assert td[keys.REWARD].item() == 0.0
        assert tuple(shown[X : Y + 1]) == start and shown[DISTANCE] == 1.0
    else:
        assert shown[X] == 707.0 if name == "right" else shown[Y] == 579.0


def test_the_start_is_shown_raw_until_the_first_move_which_goes_from_within_bounds():
    env = one()
    td = place(env, (715.0, 588.0), (640.0, 440.0))
    assert seen(td)[X : Y + 1] == [715.0, 588.0]
    after = seen(press(env, 1, IDLE))
    assert after[X : Y + 1] == [707.0, 579.0]


def test_the_goal_is_within_bounds_for_the_dock_but_not_for_the_distance():
    env = one()
    place(env, (640.0, 512.0), (715.0, 555.0))
    # A press to (698, 545.5): within 10 px of (707, 555), but not of the goal itself.
    outcome, reward, *_ = end(press(env, 2, -0.9196))
    assert outcome == SUCCESS and reward > 10.0
    assert seen(env.step(action([2], [IDLE]))["next"])[DISTANCE] == 1.0
    place(env, (640.0, 512.0), (715.0, 588.0))
    after = seen(press(env, 2, -0.96))
    expected = math.hypot(715.0 - after[X], 588.0 - after[Y]) / math.hypot(75.0, 76.0)
    assert after[DISTANCE] == pytest.approx(expected)


def test_the_velocity_outlives_a_reset_but_fuel_and_position_do_not():
    env = one()
    place(env, (640.0, 512.0), (640.0, 440.0))
    before = seen(press(env, 2, -0.96))
    again = seen(env.reset())
    assert again[VELOCITY] == before[VELOCITY] != [0.0, 0.0]
    assert again[X:11] == [640.0, 512.0] and again[FUEL:] == [1.0, 1.0]


def test_the_time_limit_is_the_999th_step():
    env = one()
    env.reset()
    for _ in range(998):
        assert not press(env, 0, IDLE)[keys.DONE].item()
    assert end(press(env, 0, IDLE)) == (TIME_LIMIT, 0.0, False, True)


def layouts(td: TensorDict) -> Tensor:
    return td[keys.OBSERVATION][:, :4]


def test_a_layout_is_frozen_for_life_unless_told_otherwise():
    frozen, fresh = ReleasedBoatDockEnv(50), ReleasedBoatDockEnv(50, frozen_layouts=False)
    first = layouts(frozen.reset())
    assert (layouts(frozen.reset()) == first).all()
    assert len(first.unique(dim=0)) == 50
    assert (layouts(fresh.reset()) == first).all()
    assert (layouts(fresh.reset()) != first).any(-1).all()
    assert (layouts(frozen.reset(frozen.fixed_episodes(0))) != first).any(-1).all()
    assert (layouts(frozen.reset()) == layouts(frozen.reset(frozen.fixed_episodes(0)))).all()


def test_key_map_zero_is_drawn_again_at_every_reset_until_it_is_one():
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
def test_layouts_are_whole_apart_and_of_their_test_mode(test_mode):
    env = ReleasedBoatDockEnv(2_000, test_mode=test_mode)
    for points in (layouts(env.reset()), torch.cat(list(env.fixed_episodes(3).values()), -1)):
        assert (points == points.round()).all()
        for axis, low in enumerate((563, 435) * 2):
            assert (points[:, axis].min().item(), points[:, axis].max().item()) == (low, low + 153)
        assert ((points[:, :2] - points[:, 2:]).norm(dim=-1) >= 100.0).all()
        within = torch.tensor([is_test_layout(*layout) for layout in points.tolist()]).float().mean().item()
        assert within == (pytest.approx(0.5, abs=0.1) if test_mode is None else test_mode)


def is_test_layout(*layout: float) -> bool:
    """Tell by angles whether the bearing between the clamped icons is under 30 degrees off 90, 210 or 330 (y down)."""
    x, y, goal_x, goal_y = (min(value, high) for value, high in zip(layout, (707, 579) * 2, strict=True))
    bearing = math.degrees(math.atan2(goal_y - y, goal_x - x))
    return abs((bearing - 90.0 + 60.0) % 120.0 - 60.0) < 30.0 - 1e-9


@pytest.mark.parametrize("observation", ["pixels", "scaled"])
@pytest.mark.parametrize("controller", ["congruent", "incongruent"])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_specs_are_kept(controller, observation, dtype):
    check_env_specs(ReleasedBoatDockEnv(5, controller=controller, observation=observation, dtype=dtype))


def test_the_action_spec_has_durations_from_minus_one_to_one():
    spec = ReleasedBoatDockEnv(2).full_action_spec[keys.DURATION]
    assert (spec.space.low == -1.0).all() and (spec.space.high == 1.0).all()


def test_scaled_observations_are_small_even_with_a_ship_full_of_fuel():
    env = ReleasedBoatDockEnv(300, observation="scaled")
    td = env.reset()
    for key in range(3):
        assert (td[keys.OBSERVATION].abs() <= 2.2).all()
        td = press(env, key, -0.95)
    for _ in range(900):
        td = press(env, 0, IDLE)
    fuel = td[keys.OBSERVATION][:, FUEL]
    assert (td[keys.OBSERVATION].abs() <= 6.0).all() and (fuel < 5.3).all()
    to_goal = td[keys.OBSERVATION][:, 2:4] - td[keys.OBSERVATION][:, X : Y + 1]
    torch.testing.assert_close(to_goal, td[keys.OBSERVATION][:, 15:])


@pytest.mark.parametrize("frozen", [True, False])
def test_a_batch_is_many_single_environments(frozen):
    generator = torch.Generator().manual_seed(0)
    few = ReleasedBoatDockEnv(2, controller="incongruent", frozen_layouts=frozen, seed=3)
    many = ReleasedBoatDockEnv(9, controller="incongruent", frozen_layouts=frozen, seed=3)
    readings = [few.reset(), many.reset()]
    for step in range(60):
        actions = action(
            torch.randint(3, (9,), generator=generator), -1.0 + 0.15 * torch.rand(9, 3, generator=generator)
        )
        readings = [few.step(actions[:2].clone())["next"], many.step(actions.clone())["next"]]
        assert (readings[0] == readings[1][:2]).all()
        if step % 5 == 0:
            readings = [
                restart(few, readings[0], [True, False]),
                restart(many, readings[1], [True, False, *[True] * 7]),
            ]
            assert (readings[0] == readings[1][:2]).all()


@pytest.mark.parametrize("seed", [0, 2**63 + 5])
def test_a_seed_fixes_everything_and_no_global_generator_is_touched(seed):
    def states() -> tuple:
        return torch.get_rng_state().tolist(), str(np.random.get_state()), random.getstate()

    env, before = ReleasedBoatDockEnv(30, controller="incongruent", seed=1), states()
    env.set_seed(seed)
    first = [env.reset(), press(env, 0, -0.95), env.reset()]
    assert states() == before
    torch.rand(3)
    env.set_seed(seed)
    again = [env.reset(), press(env, 0, -0.95), env.reset()]
    assert all((one == other).all() for one, other in zip(first, again, strict=True))
    env.set_seed(seed + 1)
    assert (layouts(env.reset()) != layouts(first[0])).any(-1).all()


def test_a_finished_episode_stays_as_it_is_and_earns_nothing():
    env = one()
    place(env, (640.0, 512.0), (640.0, 440.0))
    last = press(env, 1, STEP)
    after = press(env, 0, -0.95)
    assert after[keys.DONE].item() and after[keys.REWARD].item() == 0.0
    assert (after[keys.OBSERVATION] == last[keys.OBSERVATION]).all()


def test_a_saved_state_goes_on_as_it_would_have():
    env, copy = (ReleasedBoatDockEnv(6, controller="incongruent", frozen_layouts=False, seed=2) for _ in range(2))
    env.reset()
    press(env, 1, -0.95)
    copy.set_state_columns({name: column.clone() for name, column in env.state_columns().items()})
    for step in (lambda e: press(e, 2, -0.97), lambda e: e.reset(), lambda e: press(e, 0, -0.93)):
        assert (step(env) == step(copy)).all()
    for columns, complaint in (
        (ReleasedBoatDockEnv(2).state_columns(), r"\[2\], but must be \[6\]"),
        ({"x": 0}, "not x"),
    ):
        with pytest.raises(ValueError, match=complaint):
            env.set_state_columns(columns)


@pytest.mark.parametrize(
    ("bad", "complaint"),
    [
        (action([0, 3], [0.0, 0.0]), r"environment 1 got key=3 \(allowed 0, 1, 2\)"),
        (action([0, 1], [0.0, math.nan]), "environment 1 got key=1 .*nan"),
        (action([[0], [1]], torch.zeros(2, 3)), "shape"),
        (action([0.5, 1.0], [0.0, 0.0]), "must be integer"),
    ],
)
def test_a_bad_action_is_refused_and_harms_nothing(bad, complaint):
    env = ReleasedBoatDockEnv(2)
    env.reset()
    before = env.state_columns()
    with pytest.raises(ValueError, match=complaint):
        env.step(bad)
    assert all(torch.equal(now, before[name]) for name, now in env.state_columns().items())


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"start": (640.0, 512.0)}, "goal has shape None"),
        ({"start": (640.0, 512.0), "goal": (717.0, 512.0)}, "a goal lies outside"),
        ({"start": (640.0, 512.0), "goal": (640.0, 512.0)}, "within 1 px"),
        ({"start": (640.0, 512.0), "goal": (600.0, 512.0), "keymap": 1}, "the congruent boat has none"),
    ],
)
def test_a_layout_that_cannot_be_is_refused(given, complaint):
    with pytest.raises(ValueError, match=complaint):
        one().reset(TensorDict({name: torch.tensor([value]) for name, value in given.items()}, [1]))


@pytest.mark.parametrize(
    "arguments",
    [{"num_envs": 0}, {"max_steps": 0}, {"controller": "choose"}, {"keymap": 2}, {"test_mode": 3}, {"dtype": "int"}],
    ids=str,
)
def test_a_bad_argument_is_refused_by_name(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        ReleasedBoatDockEnv(**arguments)


def test_results_are_the_outcomes_and_the_score_is_the_return():
    env = ReleasedBoatDockEnv(5)
    outcome = torch.tensor([SUCCESS, WALL, WALL, OUT_OF_FUEL, TIME_LIMIT])
    results = env.results(TensorDict({keys.OUTCOME: outcome}, [5]))
    assert "score" not in results and results["success"].tolist() == [True, *[False] * 4]
    means = env.measure({name: value.numpy() for name, value in results.items()})
    assert means == pytest.approx({"wall": 0.4, "out_of_fuel": 0.2, "time_limit": 0.2})


def test_neither_people_s_figures_nor_a_ceiling_are_shown_beside_it():
    given = {"random": {"score": 0.1}}
    assert list(references({"env": "boatdock_released", "controller": "congruent", "references": given})) == ["random"]
