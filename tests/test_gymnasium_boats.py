"""The Gymnasium adapters of the boats keep Gymnasium's contract and play the same task as BoatDockEnv."""

from __future__ import annotations

import itertools
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from hpamdp.env import counter_rng
from hpamdp.env.boatdock.gymnasium_adapter import BoatDock, BoatDockVector

ID = "hpamdp/BoatDock-v0"
START, GOAL = np.array([640.0, 512.0]), np.array([640.0, 452.0])  # 60 px straight up, the congruent controller's key 1
NOISE = {"motor_noise": 0.2, "sensor_noise": 4.0, "slip": 0.2}
# Gymnasium recommends actions scaled to [-1, 1]; ours are seconds on purpose.
RECOMMENDATION = "we recommend using a symmetric and normalized space"


def press(key: int, seconds: float, **option: int) -> dict:
    return {"key": key, "duration": np.full(3, seconds, np.float32), **option}


def same(one, other) -> bool:
    """Return whether nested infos or observations are equal, with their types, and floats up to rounding."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, np.ndarray) and one.dtype == object:
        return one.shape == other.shape and all(map(same, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and np.allclose(one, other, atol=1e-5)
    return type(one) is type(other) and one == other


@pytest.mark.parametrize(
    ("action_format", "controller", "observation", "noise"),
    [("dict", "choose", "scaled", {}), ("tuple", "choose", "pixels", NOISE), ("dict", "random", "pixels", {})],
)
def test_gymnasiums_checker_finds_nothing(action_format, controller, observation, noise):
    env = gymnasium.make(
        ID, controller=controller, keymap="random", observation=observation, action_format=action_format, **noise
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env.unwrapped)
    assert [w for w in caught if RECOMMENDATION not in str(w.message)] == []


@pytest.mark.parametrize("observation", ["scaled", "pixels"])
@pytest.mark.parametrize("largest", [-5.8, 5.8])
def test_the_space_holds_the_largest_noise_at_the_rim(observation, largest, monkeypatch):
    env = BoatDock(controller="congruent", observation=observation, sensor_noise=30.0)
    signs = itertools.cycle([1, -1, -1, 1, -1, 1])
    monkeypatch.setattr(counter_rng, "normal", lambda key, draw: torch.full(key.bits.shape, largest * next(signs)))
    rim = np.array([119.9, 0.0])
    assert env.reset(seed=0, options={"start": START + rim, "goal": START - rim})[0] in env.observation_space
    assert env.step(press(1, 0.1))[0] in env.observation_space


def test_a_seed_fixes_the_layouts_and_a_reset_without_one_goes_on_to_the_next():
    env, other = BoatDock(), BoatDock()
    first, second = env.reset(seed=5)[0], env.reset()[0]
    assert not np.array_equal(first, second)
    for _ in range(2):
        assert np.array_equal(other.reset(seed=5)[0], first)
    assert np.array_equal(other.reset()[0], second)
    assert not np.array_equal(BoatDock().reset(seed=6)[0], first)
    many, more = (BoatDockVector(num).reset(seed=5)[0] for num in (2, 7))
    assert same(many, more[:2])
    assert same(many[0], first)


def test_unseeded_environments_differ_and_seed_themselves_from_np_random():
    envs = [BoatDock() for _ in range(3)] + [BoatDockVector(1) for _ in range(2)]
    assert len({env.reset()[0].tobytes() for env in envs}) == 5
    twins = [BoatDock(), BoatDock()]
    for env in twins:
        env.np_random = np.random.default_rng(1)
    assert np.array_equal(twins[0].reset()[0], twins[1].reset()[0])


def test_the_info_has_the_outcome_and_at_the_end_the_score():
    env = BoatDock()
    _, info = env.reset(options={"start": START, "goal": GOAL})
    assert info == {"outcome": "sailing", "fuel": 1.0, "presses": 0, "controller": -1}
    *_, terminated, truncated, info = env.step(press(1, 0.5, option=1))
    assert not terminated and not truncated
    assert info == {"outcome": "sailing", "fuel": pytest.approx(5.5 / 6.0), "presses": 1, "controller": 1}
    _, reward, terminated, truncated, info = env.step(press(1, 0.9, option=0))
    assert (terminated, truncated, info["outcome"], info["presses"]) == (True, False, "success", 2)
    assert info["score"] == pytest.approx(5.0 * info["fuel"])
    assert reward == pytest.approx(info["score"] + (60.0 - 1.95 * (0.125 * 100 / 3 - 0.0625 * 5 / 3) - 15.0) / 60.0)


def test_both_action_formats_and_the_vector_give_the_same_results():
    layout = {"start": START, "goal": GOAL + 10.0}
    single, nested = BoatDock(), BoatDock(action_format="tuple")
    many, nested_many = BoatDockVector(2), BoatDockVector(2, action_format="tuple")
    for env in (single, nested):
        env.reset(seed=0, options=layout)
    for env in (many, nested_many):
        env.reset(seed=0, options={name: np.stack([point, point]) for name, point in layout.items()})
    duration = np.array([0.1, 0.4, 0.9], np.float32)
    expected = single.step({"option": 1, "key": 1, "duration": duration})[0]
    pairs = np.stack([duration, duration])
    options = np.array([1, 0])
    columns = tuple(pairs[:, [k]] for k in range(3))
    assert same(nested.step((1, 1, tuple(duration[[k]] for k in range(3))))[0], expected)
    rows = many.step({"option": options, "key": np.array([1, 1]), "duration": pairs})[0]
    assert same(rows[0], expected)
    assert not same(rows[1], expected)
    assert same(nested_many.step((options, np.array([1, 1]), columns))[0], rows)


GOOD = {"option": 1, "key": 1, "duration": np.full(3, 0.2)}
BAD_ACTIONS = {
    "nan": {**GOOD, "duration": np.array([0.1, np.nan, 0.1])},
    "key too large": {**GOOD, "key": 3},
    "no such option": {**GOOD, "option": 2},
    "no key": {"option": 1, "duration": GOOD["duration"]},
}
BAD_TUPLES = {"too short": (1, (0.1, 0.1, 0.1)), "flat": (1, 1, np.full(3, 0.1))}


@pytest.mark.parametrize(
    ("action_format", "action"),
    [("dict", a) for a in BAD_ACTIONS.values()] + [("tuple", a) for a in BAD_TUPLES.values()],
    ids=[*BAD_ACTIONS, *(f"tuple {name}" for name in BAD_TUPLES)],
)
def test_an_invalid_action_is_refused_in_one_line_and_changes_nothing(action_format, action):
    env, untouched = (BoatDock(action_format=action_format) for _ in range(2))
    good = press(1, 0.2, option=1) if action_format == "dict" else (1, 1, tuple(np.full((3, 1), 0.2)))
    for each in (env, untouched):
        each.reset(seed=0)
    with pytest.raises(ValueError, match=r"^step: [^\n]+$"):
        env.step(action)
    assert same(env.step(good)[0], untouched.step(good)[0])


@pytest.mark.parametrize(
    "options",
    [
        {"start": START},
        {"start": START, "goal": START},
        {"start": START, "goal": GOAL, "controller": 1},
        {"begin": START},
    ],
)
def test_an_invalid_reset_option_is_refused_in_one_line_and_changes_nothing(options):
    env, untouched = BoatDock(), BoatDock()
    for each in (env, untouched):
        each.reset(seed=0)
    for seed in (None, 9):
        with pytest.raises(ValueError, match=r"^reset: [^\n]+$"):
            env.reset(seed=seed, options=options)
    assert same(env.step(GOOD)[0], untouched.step(GOOD)[0])
    assert same(env.reset()[0], untouched.reset()[0])


def test_stepping_and_rendering_before_the_first_reset_is_refused():
    env = BoatDock(render_mode="rgb_array")
    for call in (lambda: env.step(GOOD), env.render, lambda: BoatDockVector(2).step(GOOD)):
        with pytest.raises(gymnasium.error.ResetNeeded):
            call()


def layouts(num: int) -> dict[str, np.ndarray]:
    """Return layouts in which boats have different outcomes."""
    angle = np.linspace(0.0, 6.0, num)[:, None]
    around = np.concatenate([np.cos(angle), np.sin(angle)], 1)
    return {"start": START + 20.0 * around, "goal": START + 90.0 * around[::-1]}


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_the_vector_behaves_like_gymnasiums_vector_of_single_boats(mode):
    num = 12
    ours = gymnasium.make_vec(
        ID, num, vectorization_mode="vector_entry_point", controller="congruent", autoreset_mode=mode
    )
    theirs = SyncVectorEnv([lambda: BoatDock(controller="congruent")] * num, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is AutoresetMode(mode)
    assert (ours.action_space, ours.observation_space) == (theirs.action_space, theirs.observation_space)
    given = layouts(num)
    assert same(ours.reset(seed=0, options=given)[1], theirs.reset(seed=0)[1])
    for row, env in enumerate(theirs.envs):
        env.reset(options={name: points[row] for name, points in given.items()})
    ours.action_space.seed(0)
    fresh = ended = np.zeros(num, bool)
    # New episodes have other seeds, so the comparison ends with the first of them.
    while not fresh.any() and not (mode == "Disabled" and ended.any()):
        actions = ours.action_space.sample()
        actions["duration"] *= 0.6
        (seen, *flags, infos), (expected, *expected_flags, expected_infos) = ours.step(actions), theirs.step(actions)
        fresh = infos["presses"] == 0
        ended = flags[1] | flags[2]
        assert np.allclose(seen[~fresh], expected[~fresh], atol=1e-5)
        assert all(np.allclose(one, other, atol=1e-5) for one, other in zip(flags, expected_flags, strict=True))
        assert [flag.dtype for flag in flags] == [flag.dtype for flag in expected_flags]
        assert same(infos, expected_infos)
    assert num > fresh.sum() + ended.sum() > 0


def test_a_reset_mask_resets_only_its_boats():
    env = BoatDockVector(3, controller="congruent", autoreset_mode="Disabled")
    env.reset(seed=0)
    before = env.step({"key": np.zeros(3, int), "duration": np.full((3, 3), 0.1)})[0]
    observations, infos = env.reset(options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(observations[[0, 2]], before[[0, 2]])
    assert infos["_presses"].tolist() == [False, True, False]
    for mask in ([True, False, False], np.zeros(3, bool), np.ones(2, bool), np.ones(3)):
        with pytest.raises(ValueError, match="reset_mask"):
            env.reset(options={"reset_mask": mask})
