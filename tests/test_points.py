"""The field's domains play as recordings of the reference code; quirks and figures of those with a point."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import pytest
import torch
from batched_players import action, agrees, play, random_player
from scripts import load_script
from tensor_rules import goal
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.env.batched_env import BatchedEnv
from hpamdp.env.catch_point import rules as catch_point
from hpamdp.env.catch_point.environment import CatchPointEnv
from hpamdp.env.gym_hybrid import rules as gym_hybrid
from hpamdp.env.gym_hybrid.environment import MovingEnv, SlidingEnv
from hpamdp.env.hard_move import rules as hard_move
from hpamdp.env.hard_move.environment import HardMoveEnv

REPLAY = Path(__file__).resolve().parent.parent / "experiments" / "domains" / "replay.py"
FOLDER = Path(os.environ.get("HPAMDP_TRACES", "nowhere")) / "domains"
NAMES = ["platform", "goal", "hard_goal", "catch_point", "moving", "sliding"]
NAMES += [f"hard_move_{n}" for n in (4, 6, 8, 10)]


def place(env: BatchedEnv, **columns: float) -> None:
    """Start episodes and change columns of the state."""
    env.reset()
    state = env.env_state()
    env.set_env_state(state | {name: torch.full_like(state[name], value) for name, value in columns.items()})


def act(env: BatchedEnv, discrete: int, parameter: float = 0.0) -> TensorDict:
    parameters = torch.full((env.num_envs, sum(env.parameter_dims)), parameter)
    return env.step(action(torch.full((env.num_envs,), discrete), parameters))["next"]


def scripted(env: BatchedEnv) -> TensorDict:
    discrete, parameter = env.scripted_action(env.state)
    return action(discrete, parameter.unsqueeze(-1).expand(-1, sum(env.parameter_dims)))


def success(env: BatchedEnv, player) -> tuple[Tensor, Tensor]:
    """Return which episodes succeed, as 0 or 1, and their returns, `[N]` each."""
    last, total = play(env, player)
    return env.results(last)["success"].float(), total


# Figures of another implementation. Shares have standard errors below .005 there; those of the returns are 0.2, or 0.01
# in Moving and Sliding.
@pytest.mark.parametrize(
    ("make", "share", "mean", "error"),
    [
        (lambda: CatchPointEnv(4000), 0.961, 8.5, 0.2),
        (lambda: CatchPointEnv(4000, max_steps=30), 0.997, None, None),
        (lambda: HardMoveEnv(4000, n=4), 0.962, 7.0, 0.2),
        (lambda: HardMoveEnv(2000, n=10), 0.995, 9.0, 0.2),
        (lambda: HardMoveEnv(4000, n=4, max_steps=25), 0.852, None, None),
        (lambda: MovingEnv(1000), 0.9995, 1.867, 0.01),
        (lambda: SlidingEnv(1000), 0.9985, 1.856, 0.01),
    ],
    ids=["catch", "catch in 30", "hard 4", "hard 10", "hard 4 in 25", "moving", "sliding"],
)
def test_the_scripted_player_reaches_the_known_figures(make, share, mean, error):
    succeeds, returns = success(make(), scripted)
    assert agrees(succeeds, share, 0.005)
    assert mean is None or agrees(returns, mean, error)


@pytest.mark.parametrize(
    ("make", "share", "mean", "error"),
    [
        (lambda: CatchPointEnv(4000), 0.049, -27.7, 0.2),
        (lambda: HardMoveEnv(4000, n=4), 0.049, -39.5, 0.3),
        (lambda: HardMoveEnv(2000, n=8), 0.037, -39.5, 0.3),
        (lambda: MovingEnv(4000), 0.004, -1.30, 0.005),
        (lambda: SlidingEnv(4000), 0.011, -1.24, 0.005),
    ],
    ids=["catch", "hard 4", "hard 8", "moving", "sliding"],
)
def test_random_play_reaches_the_known_figures(make, share, mean, error):
    succeeds, returns = success(make(), random_player(3))
    assert succeeds.any() and agrees(succeeds, share, 0.002)
    assert agrees(returns, mean, error)


def test_an_episode_of_catch_point_has_eleven_catches_and_ends_a_step_after_the_last():
    env = CatchPointEnv(1)
    place(env, x=0.0, y=0.0, target_x=1.0, target_y=0.0)
    readings = [act(env, catch_point.CATCH) for _ in range(12)]
    assert [reading[keys.REWARD].item() for reading in readings] == [-1.0] * 11 + [0.0]
    assert [reading[keys.TERMINATED].item() for reading in readings] == [False] * 11 + [True]
    assert readings[-1][keys.OUTCOME].item() == catch_point.NO_CATCHES_LEFT


def test_the_papers_ten_catches_end_at_once():
    env = CatchPointEnv(1, catches=10, late_end=False)
    place(env, x=0.0, y=0.0, target_x=1.0, target_y=0.0)
    readings = [act(env, catch_point.CATCH) for _ in range(10)]
    assert [reading[keys.REWARD].item() for reading in readings] == [-1.0] * 10
    assert [reading[keys.TERMINATED].item() for reading in readings] == [False] * 9 + [True]


def test_a_catch_within_reach_earns_twenty_less_the_squared_distance():
    env = CatchPointEnv(1)
    place(env, x=0.0, y=0.0, target_x=0.1, target_y=0.0)
    reading = act(env, catch_point.CATCH)
    assert reading[keys.REWARD].item() == pytest.approx(19.99)
    assert reading[keys.TERMINATED].item()
    assert env.results(reading)["success"].item()


def test_a_move_goes_clockwise_from_upwards_at_full_force():
    for parameter, expected in ((0.0, (0.0, 0.2)), (0.5, (0.2, 0.0)), (-0.5, (-0.2, 0.0)), (1.0, (0.0, -0.2))):
        env = CatchPointEnv(1)
        place(env)
        assert act(env, catch_point.MOVE, parameter)[keys.OBSERVATION][0, :2].tolist() == pytest.approx(
            expected, abs=1e-6
        )


def test_misses_and_time_are_observed_where_wanted():
    env = CatchPointEnv(1, progress=True)
    place(env, x=0.0, target_x=1.0)
    seen = [act(env, catch_point.CATCH)[keys.OBSERVATION][0, 4:].tolist() for _ in range(2)]
    assert seen == [pytest.approx([-5 / 6, -11 / 12]), pytest.approx([-4 / 6, -10 / 12])]
    assert CatchPointEnv(1).reset()[keys.OBSERVATION].shape == (1, 4)


@pytest.mark.parametrize(("n", "different"), [(4, 9), (6, 19), (8, 81), (10, 211)])
def test_many_sets_of_actuators_have_the_same_motion(n, different):
    motions = hard_move.motions(n, rounded=True)
    assert motions.shape == (2**n, 2)
    assert motions.norm(dim=-1).max().item() == pytest.approx(1.0)
    assert len(motions.round(decimals=6).unique(dim=0)) == different
    # Actuator 0, the highest bit, points to the right.
    assert motions[2 ** (n - 1)].tolist() == pytest.approx([motions[2 ** (n - 1)].norm().item(), 0.0])


@pytest.mark.parametrize("n", [4, 10])
def test_a_set_of_actuators_pushes_along_its_motion_and_backwards_below_zero(n):
    motions = hard_move.motions(n, rounded=True)
    for parameter in (1.0, -0.5):
        env = HardMoveEnv(1, n=n)
        place(env)
        velocity = act(env, 2 ** (n - 2) + 1, parameter)[keys.OBSERVATION][0, :2]
        torch.testing.assert_close(velocity, (0.2 * parameter * motions[2 ** (n - 2) + 1]).float())


def test_moving_lasts_201_steps_and_the_last_costs_one():
    env = MovingEnv(1)
    place(env, x=0.0, y=0.0, target_x=0.5, target_y=0.5)
    for _ in range(200):
        reading = act(env, gym_hybrid.TURN)
        assert not reading[keys.DONE].item()
    assert reading[keys.REWARD].item() == pytest.approx(-0.001)
    reading = act(env, gym_hybrid.TURN)
    assert reading[keys.TRUNCATED].item() and not reading[keys.TERMINATED].item()
    assert reading[keys.REWARD].item() == -1.0


@pytest.mark.parametrize("problem", [MovingEnv, SlidingEnv])
def test_a_stop_at_the_target_succeeds_even_in_the_last_step(problem):
    env = problem(1)
    place(env, x=0.0, y=0.0, target_x=0.05, target_y=0.0, steps=200)
    reading = act(env, gym_hybrid.BRAKE)
    assert reading[keys.REWARD].item() == pytest.approx(0.999)
    assert reading[keys.TERMINATED].item() and env.results(reading)["success"].item()


@pytest.mark.parametrize("problem", [MovingEnv, SlidingEnv])
def test_leaving_the_field_terminates_and_costs_one(problem):
    env = problem(1)
    place(env, x=0.999, y=0.0, heading=0.0, course=0.0, speed=1.0, target_x=0.0)
    reading = act(env, gym_hybrid.TURN)
    assert reading[keys.TERMINATED].item() and reading[keys.REWARD].item() == -1.0
    assert reading[keys.OUTCOME].item() == gym_hybrid.LEFT_FIELD


def test_a_turn_changes_the_course_in_moving_but_not_in_sliding():
    for problem, expected in ((MovingEnv, (0.0, 0.005)), (SlidingEnv, (0.005, 0.0))):
        env = problem(1)
        place(env, x=0.0, y=0.0, heading=0.0, course=0.0, speed=1.0, target_x=-0.5, target_y=-0.5)
        assert act(env, gym_hybrid.TURN, 1.0)[keys.OBSERVATION][0, :2].tolist() == pytest.approx(expected, abs=1e-7)


def test_in_sliding_an_acceleration_adds_to_the_velocity_as_a_vector():
    env = SlidingEnv(1)
    place(env, x=0.0, y=0.0, heading=math.pi / 2.0, course=0.0, speed=0.5)
    act(env, gym_hybrid.ACCELERATE, 1.0)
    assert env.state.speed.item() == pytest.approx(math.sqrt(0.5))
    assert env.state.course.item() == pytest.approx(math.pi / 4.0)


def load_replay():
    return load_script(REPLAY)


@pytest.fixture(scope="module")
def tool():
    return load_replay()


def recording(name: str) -> Path:
    path = FOLDER / f"{name}.json"
    if not path.exists():
        pytest.skip(f"needs HPAMDP_TRACES with domains/{name}.json")
    return path


@pytest.mark.parametrize("name", NAMES)
def test_our_rules_play_as_the_reference_code(tool, name):
    document = json.loads(recording(name).read_text())
    for dtype, step_by_step, tolerance in (
        (torch.float64, False, 1e-9),
        (torch.float64, True, 1e-9),
        (torch.float32, True, tool.load(document).float32_tolerance),
    ):
        report = tool.replay(document, dtype, step_by_step=step_by_step)
        assert report.steps == sum(len(episode["steps"]) for episode in document["episodes"]) > 80
        assert not report.mismatches
        assert report.worst <= tolerance


@pytest.mark.parametrize("name", ["goal", "hard_goal"])
def test_observations_are_scaled_as_for_the_published_learners(tool, name):
    document = json.loads(recording(name).read_text())
    starts = [episode["initial"] for episode in document["episodes"]]
    state = tool.load(document).states([start["state"] for start in starts], [0] * len(starts), torch.float64)
    expected = torch.tensor([start["scaled_observation"] for start in starts], dtype=torch.float64)
    torch.testing.assert_close(goal.observe(state), expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("change", [{"outcome": "caught"}, {"reward": math.nan}], ids=str)
def test_the_replay_finds_a_wrong_outcome_and_a_nan(tool, change, tmp_path):
    document = json.loads(recording("catch_point").read_text())
    document["episodes"][1]["steps"][3].update(change)
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(document))
    assert tool.main([str(path)]) == 1
