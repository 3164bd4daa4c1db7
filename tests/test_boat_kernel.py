"""The kernel that moves boats on the CPU against the tensor functions, which are the truth."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from tensor_rules import boat_rules

from hpamdp import keys
from hpamdp.env import counter_rng, kernels
from hpamdp.env.boatdock import kernel, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.rng_streams import folded

POSITIONS = ("start_x", "start_y", "goal_x", "goal_y", "x", "y")
SETTINGS = {
    "controller": st.sampled_from(["choose", "congruent", "incongruent", "random"]),
    "keymap": st.sampled_from([1, 2, "random"]),
    "reward": st.sampled_from(["paper", "sparse"]),
    "observation": st.sampled_from(["scaled", "pixels"]),
    "motor_noise": st.sampled_from([0.0, 0.2, [0.1, 0.0], [0.0, 0.3]]),
    "sensor_noise": st.sampled_from([0.0, 3.0]),
    "slip": st.sampled_from([0.0, 0.3, 1.0]),
}
SIDEWAYS = {"sideways": [0.0, 100.0, 215.0]}
# Other boats, and changes between boats.
BOAT_SETTINGS = [
    {"boats": ["congruent", "incongruent1", "incongruent2"]},
    {"boats": ["congruent", "sideways", "incongruent2"], "controllers": SIDEWAYS, "controller": "random"},
    {"boats": ["congruent", "sideways"], "controllers": SIDEWAYS, "controller": "sideways"},
    {"switch_cost": 0.3},
    {"switch_cost": 0.0, "keymap": "random"},
    {"boats": ["sideways", "incongruent1", "congruent"], "controllers": SIDEWAYS, "switch_cost": 1.5},
]


def random_action(num_envs: int, generator: torch.Generator, num_boats: int = 2) -> dict:
    """Return presses of which many are short, so that episodes last, and some are out of their bounds."""
    durations = 2.4 * torch.rand(num_envs, 3, generator=generator).pow(3) - 0.05
    return {
        keys.OPTION: torch.randint(num_boats, (num_envs,), generator=generator),
        keys.DISCRETE: torch.randint(3, (num_envs,), generator=generator),
        keys.PARAMETERS: durations,
    }


def rounding_of_positions(before, after, has_motor_noise: bool) -> torch.Tensor:
    """Return by how many px rounding may part the two positions after a press.

    From the same state both do the same float32 operations, so coordinates of up to 120 px differ by two units in the
    last place at most: 1.5e-5 px, here doubled. With motor noise they start from different durations. Its logarithm,
    cosine and exponential come from two libraries, which together differ by up to four units in the last place. The
    distance grows with the cube of the duration, so its relative difference is three times as large.
    """
    longest_way = torch.maximum((after.x - before.x).abs(), (after.y - before.y).abs())
    of_duration = 4.0 * torch.finfo(torch.float32).eps if has_motor_noise else 0.0
    return 3e-5 + 3.0 * of_duration * longest_way


def compare(state, expected, same, rounding):
    """Assert that two states are the same in the rows of `same`, positions up to `rounding` px."""
    for name, column, right in zip(state._fields, state, expected, strict=True):
        column, right = column[same], right[same]
        if name in POSITIONS:
            assert ((column - right).abs() <= rounding[same]).all(), name
        elif column.is_floating_point():
            assert torch.allclose(column, right, atol=2e-3 if "velocity" in name else 2e-5, rtol=1e-5), name
        else:
            assert torch.equal(column, right), name


def play(num_envs: int, num_steps: int, seed: int, is_evaluation: bool = False, **rules) -> tuple[set[int], int]:
    """Compare `num_steps` steps and resets with the tensor functions; return the outcomes met and the rows that differ.

    Rows may differ where an event, or whether a layout is too near, is a tie to within rounding.
    """
    env = BoatDockEnv(num_envs, seed=seed, first_env=7, **rules)
    if is_evaluation:
        env.seed_evaluation(seed)
    td = env.reset()
    by_tensors = boat_rules.TensorBoats(num_envs, seed=seed, first_env=7, **rules)
    if is_evaluation:
        by_tensors.seed_evaluation(seed)
    generator = torch.Generator().manual_seed(seed)
    outcomes, num_different = set(), 0
    for _ in range(num_steps):
        action = random_action(num_envs, generator, len(env.option_names))
        before = env.state
        option = action[keys.OPTION] if env.has_choice else None
        is_idle = before.outcome != physics.SAILING
        moved, reward, _ = by_tensors.advance(before, option, action[keys.DISCRETE], action[keys.PARAMETERS], is_idle)
        for name, leaf in action.items():
            if name != keys.OPTION or env.has_choice:
                td[name] = leaf
        td, root = env.step_and_maybe_reset(td)
        after = td["next"]
        same = after[keys.OUTCOME] == moved.outcome
        num_different += int((~same).sum())
        by_tensors.state = moved
        reading = by_tensors.read()
        for name in ("observation", "fuel", "done", "terminated", "truncated"):
            left, right = after[name][same].float(), reading[name][same].float()
            assert torch.allclose(left, right, atol=1e-3 if rules.get("observation") == "pixels" else 3e-5), name
        assert torch.allclose(after[keys.REWARD][same, 0], reward[same], atol=1e-5)
        # What starts anew is compared from the same state, too.
        done = after[keys.DONE][:, 0]
        fresh = by_tensors.restart(moved, done)
        is_other_try = (env.state.start_x - fresh.start_x).abs() > 1.0
        num_different += int((is_other_try & same).sum())
        same = same & ~is_other_try
        compare(env.state, fresh, same, rounding_of_positions(before, moved, max(by_tensors.options.noises) > 0.0))
        again = by_tensors.observe(fresh)
        assert torch.allclose(
            root["observation"][same], again[same], atol=1e-3 if rules.get("observation") == "pixels" else 3e-5
        )
        outcomes |= set(after[keys.OUTCOME].tolist())
        td = root
    return outcomes, num_different


@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), is_evaluation=st.booleans(), rules=st.fixed_dictionaries(SETTINGS))
def test_the_kernel_does_what_the_tensor_functions_do_with_all_settings(seed, is_evaluation, rules):
    _, num_different = play(300, 6, seed, is_evaluation, **rules)
    assert num_different <= 1


@pytest.mark.parametrize("rules", BOAT_SETTINGS, ids=str)
def test_the_kernel_does_what_the_tensor_functions_do_with_other_boats_and_changes(rules):
    noise = len(rules.get("boats", "ab")) * [0.1]
    for seed, disturbed in enumerate(({}, {"motor_noise": [*noise[:-1], 0.3], "slip": 0.2, "sensor_noise": 2.0})):
        _, num_different = play(300, 6, seed, **rules, **disturbed)
        assert num_different <= 1


@pytest.mark.parametrize("num_envs", [1, 127, 128, 129])
def test_blocks_of_any_size_are_whole(num_envs):
    play(num_envs, 4, 3, controller="choose", observation="scaled")


def test_all_outcomes_come_up_in_the_comparison():
    outcomes, _ = play(3000, 30, 1, controller="choose", observation="scaled")
    assert outcomes >= set(range(physics.TIME_LIMIT))


@pytest.mark.slow
def test_a_million_random_steps_agree():
    _, num_different = play(100_000, 10, 5, controller="random", observation="scaled", slip=0.1, motor_noise=0.1)
    assert num_different <= 20


def test_random_numbers_are_the_same_bit_for_bit():
    @njit
    def draw(seed, stream, environments, episodes, drawn):
        key, step = kernels.stream_hash(seed, stream), kernels.stream_step(stream)
        for row in range(len(environments)):
            bits = kernels.episode_hash(key, environments[row], episodes[row])
            for index in range(drawn.shape[1]):
                drawn[row, index] = kernels.uniform(bits, step, index)

    rng = np.random.default_rng(0)
    environments, episodes = (rng.integers(-1, 2**31 - 1, 2000).astype(np.int32) for _ in range(2))
    drawn = np.empty((2000, 30), np.float32)
    for seed in (0, 1, -3, 2**40 + 7):
        for stream in range(4):
            draw(folded(seed), stream, environments, episodes, drawn)
            where = torch.from_numpy(environments), torch.from_numpy(episodes)
            key = counter_rng.rng_key(counter_rng.seed_tensor(seed), stream, *where)
            right = torch.stack([counter_rng.uniform(key, index) for index in range(30)], -1)
            assert np.array_equal(drawn, right.numpy())


def test_a_state_that_was_read_does_not_change_with_the_boats():
    env = BoatDockEnv(3)
    td = env.reset()
    state, saved = env.state, env.env_state()
    env.step(env.rand_action(td))
    assert (state.presses == 0).all() and (saved["presses"] == 0).all() and (env.state.presses == 1).all()


def test_a_change_of_any_source_compiles_kernels_anew():
    cached = kernels.kernel(play)._cache._cache_file
    sources, own_file = cached._source_stamp  # the kernel `play` is outside the package
    assert (sources,) == kernels.sources() and own_file
    assert kernel.advance._cache._cache_file._source_stamp == kernels.sources()
