"""The kernels of the field's domains against their published rules as tensor functions."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from tensor_rules import with_tensor_rules

from hpamdp import keys
from hpamdp.env import counter_rng, kernels
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.catch_point.environment import CatchPointEnv
from hpamdp.env.circuit.environment import CircuitEnv
from hpamdp.env.goal.environment import GoalEnv, HardGoalEnv
from hpamdp.env.gym_hybrid.environment import MovingEnv, SlidingEnv
from hpamdp.env.hard_move.environment import HardMoveEnv
from hpamdp.env.office.environment import OfficeEnv
from hpamdp.env.pinball.environment import PinballEnv
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.env.rng_streams import folded

GOAL = {
    "observation": st.sampled_from(["scaled", "raw"]),
    "noise": st.sampled_from([0.0, 1.0, 2.0]),
    "max_steps": st.sampled_from([2, 100]),
}
GOAL_SLIPS = ["kick_to", "goal_distance", "keeper_projection"]
# Each problem with its settings, and how far rounding may go within an action.
PROBLEMS = {
    "goal": (GoalEnv, {**GOAL, "repaired": st.lists(st.sampled_from(GOAL_SLIPS), unique=True)}, 5e-3),
    "hard_goal": (
        HardGoalEnv,
        {**GOAL, "repaired": st.lists(st.sampled_from([*GOAL_SLIPS, "middle_shots"]), unique=True)},
        5e-3,
    ),
    "catch_point": (
        CatchPointEnv,
        {
            "max_steps": st.sampled_from([3, 25]),
            "catches": st.sampled_from([1, 11]),
            "late_end": st.booleans(),
            "progress": st.booleans(),
        },
        1e-5,
    ),
    "hard_move": (
        HardMoveEnv,
        {"n": st.sampled_from([4, 6]), "rounded_directions": st.booleans(), "max_steps": st.sampled_from([3, 30])},
        1e-5,
    ),
    "moving": (MovingEnv, {"max_steps": st.sampled_from([3, 201])}, 1e-5),
    "sliding": (SlidingEnv, {"max_steps": st.sampled_from([3, 201])}, 1e-4),
}


def play(env, ruled, num_steps: int, tolerance: float) -> tuple[set[int], int]:
    """Compare steps and resets with the rules; return the outcomes met and how many rows differ by more than rounding.

    A row may differ where a threshold is met to within rounding, as when two bodies just touch.
    """
    td = env.reset()
    outcomes, num_different = set(), 0
    for _ in range(num_steps):
        td = env.rand_action(td)
        before = env.state
        moved, reward, _ = ruled.advance(before, *env.action_leaves(td), before.outcome != 0)
        fresh = ruled.restart(moved, moved.outcome != 0)
        td, root = env.step_and_maybe_reset(td)
        pairs = [
            *zip(env.state, fresh, strict=True),
            (td["next", keys.REWARD], reward.unsqueeze(-1)),
            (td["next", "observation"], ruled.observe(moved)),
            (root["observation"], ruled.observe(fresh)),
            (td["next", keys.OUTCOME], moved.outcome),
            (td["next", keys.TRUNCATED], (moved.outcome == len(env.outcomes) - 1).unsqueeze(-1)),
            (td["next", keys.DONE], (moved.outcome != 0).unsqueeze(-1)),
        ]
        differs = torch.zeros(env.num_envs, dtype=torch.bool)
        for one, other in pairs:
            near = torch.isclose(one.double(), other.double(), rtol=1e-4, atol=tolerance)
            differs |= ~near.reshape(env.num_envs, -1).all(-1)
        num_different += int(differs.sum())
        outcomes |= set(td["next", keys.OUTCOME].tolist())
        td = root
    return outcomes, num_different


# Hard Goal differs from Goal in its actions alone.
@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=[pytest.mark.slow] if each == "hard_goal" else []) for each in PROBLEMS]
)
@settings(max_examples=4, deadline=None)
@given(data=st.data(), seed=st.integers(0, 2**32 - 1), is_evaluation=st.booleans())
def test_a_kernel_does_what_the_rules_say_with_all_settings(name, data, seed, is_evaluation):
    problem, choices, tolerance = PROBLEMS[name]
    env = problem(200, seed=seed, first_env=5, **data.draw(st.fixed_dictionaries(choices)))
    ruled = with_tensor_rules(env, seed)
    if is_evaluation:
        env.seed_evaluation(seed)
        ruled.seed_evaluation(seed)
    assert play(env, ruled, 2 if name == "goal" else 4, tolerance)[1] <= 3


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n == "hard_goal" else []) for n in PROBLEMS]
)
def test_the_comparison_meets_every_outcome_but_the_rarest(name):
    torch.manual_seed(0)
    problem, _, tolerance = PROBLEMS[name]
    env = problem(2000, seed=1, max_steps=4)
    outcomes, num_different = play(env, with_tensor_rules(env, 1), 5 if name == "goal" else 12, tolerance)
    assert len(outcomes) >= len(problem.outcomes) - 1
    assert num_different <= 12


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_a_million_random_steps_agree(name):
    problem, _, tolerance = PROBLEMS[name]
    env = problem(50_000, seed=2)
    assert play(env, with_tensor_rules(env, 2), 20, tolerance)[1] <= 500


@pytest.mark.parametrize("problem", [GoalEnv, PinballEnv, OfficeEnv, BoatDockEnv])
def test_the_step_with_a_reset_returns_what_torchrls_own_does(problem):
    fast, slow = problem(100, seed=2), problem(100, seed=2)
    one, other = fast.reset(), slow.reset()
    for _ in range(4):
        action = fast.rand_action(one.clone()).select(keys.OPTION, keys.ACTION, strict=False)
        fast_step, one = fast.step_and_maybe_reset(one.update(action))
        # An entry that the environment does not know takes TorchRL's way.
        slow_step, other = slow.step_and_maybe_reset(other.update(action).set("mark", torch.zeros(100)))
        slow_step, other = slow_step.exclude("mark"), other.exclude("mark")
        assert set(fast_step.keys(True)) == set(slow_step.keys(True)) and set(one.keys(True)) == set(other.keys(True))
        assert (fast_step == slow_step).all() and (one == other).all()


# Some kernels play sixteen or thirty-two rows side by side.
@pytest.mark.parametrize(
    "problem", [*(problem for problem, _, _ in PROBLEMS.values()), PlatformEnv, PinballEnv, CircuitEnv]
)
def test_a_row_is_the_same_to_the_bit_in_every_batch(problem):
    for num in (15, 33):
        many = problem(num, seed=4, first_env=3, max_steps=3)
        td = many.reset()
        rows = [0, num // 2, num - 1]
        ones = [problem(1, seed=4, first_env=3 + row, max_steps=3) for row in rows]
        for one in ones:
            one.reset()
        for _ in range(5):
            taken = many.rand_action(td.clone()).select(keys.ACTION)
            after, td = many.step_and_maybe_reset(td.update(taken))
            for row, one in zip(rows, ones, strict=True):
                alone, _ = one.step_and_maybe_reset(taken[row : row + 1].clone())
                for entry in (keys.OBSERVATION, keys.REWARD, keys.OUTCOME, keys.DONE):
                    assert torch.equal(alone["next", entry], after["next", entry][row : row + 1])
                for own, column in zip(one.state, many.state, strict=True):
                    assert torch.equal(own, column[row : row + 1])


@pytest.mark.parametrize(
    "problem", [PlatformEnv, OfficeEnv, PinballEnv, CircuitEnv, GoalEnv, MovingEnv, CatchPointEnv, BoatDockEnv]
)
def test_a_kernel_alone_serves_tensors_on_another_device(problem):
    limit = {} if problem is BoatDockEnv else {"max_steps": 4}
    here, there = (problem(5, seed=3, **limit) for _ in range(2))
    there._is_on_cpu = False  # so that all tensors are moved, here from the CPU to it
    actions = [here.rand_action(here.reset()).select(keys.OPTION, keys.ACTION, strict=False) for _ in range(9)]
    for env in (here, there):
        env.set_seed(2)
    one, other = here.reset(), there.reset()
    for taken in actions:
        (stepped, one), (moved, other) = (
            env.step_and_maybe_reset(td.update(taken.clone())) for env, td in ((here, one), (there, other))
        )
        assert (stepped == moved).all() and (one == other).all()
    there.set_env_state(here.env_state())
    assert all(torch.equal(*pair) for pair in zip(here.state, there.state, strict=True))


def test_angles_and_sines_are_accurate_to_the_last_digits():
    @njit
    def compute(y, x, angles, sines):
        for i in range(len(x)):
            angles[i] = kernels.atan2(y[i], x[i])
            sines[0, i], sines[1, i] = kernels.sin_cos(x[i])

    rng = np.random.default_rng(0)
    num = 200_000
    # Of all sizes and, in the second half, near the diagonals and the axes.
    x, y = (rng.choice([-1.0, 1.0], num) * 10.0 ** rng.uniform(-12.0, 8.0, num) for _ in range(2))
    slope = rng.choice([0.0, 1.0], num // 2) + 10.0 ** rng.uniform(-9.0, -1.0, num // 2)
    y[num // 2 :] = slope * x[num // 2 :]
    x, y = x.astype(np.float32), y.astype(np.float32)
    angles, sines = np.empty(num, np.float32), np.empty((2, num), np.float32)
    compute(y, x, angles, sines)
    right = np.arctan2(y.astype(np.float64), x.astype(np.float64))
    large = np.abs(right) > 1e-30
    assert (np.abs(angles - right)[large] <= 2.5 * np.spacing(np.abs(angles[large]))).all()
    x = rng.uniform(-50.0, 50.0, num).astype(np.float32)
    compute(y, x, angles, sines)
    wide = x.astype(np.float64)
    assert np.abs(sines - np.stack([np.sin(wide), np.cos(wide)])).max() < 1.2e-7


def test_the_angle_of_a_vector_along_an_axis_has_numpys_signs():
    @njit
    def compute(y, x, angles):
        for i in range(len(x)):
            angles[i] = kernels.atan2(y[i], x[i])

    sides = np.array([-2.0, -0.0, 0.0, 2.0], np.float32)
    y, x = (side.ravel() for side in np.meshgrid(sides, sides))
    angles = np.empty(16, np.float32)
    compute(y, x, angles)
    right = np.arctan2(y, x)
    np.testing.assert_array_max_ulp(angles, right, 1)
    assert (np.signbit(angles) == np.signbit(right)).all()


def test_a_new_episode_is_counted_and_has_the_keys_of_the_tensor_functions():
    @njit
    def begin(integers, settings, bits, steps):
        for row in range(integers.shape[1]):
            bits[0, row], steps[0] = kernels.new_episode(integers, row, settings)
            bits[1, row], steps[1] = kernels.noise_rng(settings, row, integers[-1, row])

    seed, first_env, num = 2**35 + 3, 7, 50
    streams = (counter_rng.EVALUATION, counter_rng.EVALUATION_NOISE)
    episode = np.arange(num, dtype=np.int32) - 1
    # A row of the problem's own, then steps, outcome and episode.
    integers = np.stack([np.full(num, 9, np.int32), np.full(num, 4, np.int32), np.full(num, 2, np.int32), episode])
    bits, steps = np.zeros((2, num), np.uint32), np.zeros(2, np.uint32)
    begin(integers, np.array([float(folded(seed)), *streams, first_env, 100.0]), bits, steps)
    assert (integers[0] == 9).all() and (integers[1:3] == 0).all() and (integers[3] == episode + 1).all()
    environment = torch.arange(first_env, first_env + num, dtype=torch.int32)
    for i, stream in enumerate(streams):
        key = counter_rng.rng_key(counter_rng.seed_tensor(seed), stream, environment, torch.from_numpy(integers[3]))
        assert np.array_equal(bits[i].view(np.int32), key.bits.numpy())
        assert steps[i] == key.step & 0xFFFFFFFF


def test_rules_that_only_a_kernel_has_are_not_overridden_in_silence():
    class Other(PlatformEnv):
        def act(self, *args):
            return super().act(*args)

    with pytest.raises(TypeError, match=r"^Other: overrides act, but only the kernel of PlatformEnv has rules$"):
        Other(num_envs=2)
