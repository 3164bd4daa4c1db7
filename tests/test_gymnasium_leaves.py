"""Observed values are compared with their space before any conversion, leaf by leaf."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium_players import make, step
from toy_environments import Toy

from hpamdp.env.base import ProblemError
from hpamdp.env.gymnasium.observation_spaces import ObservationSpace
from hpamdp.env.gymnasium.scaling import ObservationScaling

INT64 = spaces.Box(-9, 9, (2,), np.int64)
BYTES = spaces.Box(0, 255, (2,), np.uint8)
BOOLS = spaces.Box(0, 1, (2,), bool)
HALVES = spaces.Box(-np.inf, np.inf, (2,), np.float16)
UNIT = spaces.Box(-1.0, 1.0, (2,))
WIDE = spaces.Box(-np.inf, np.inf, (2,), np.float64)
PARTS = spaces.Dict(a=spaces.Box(-9, 9, (2,)), b=spaces.Dict(c=spaces.Box(-9, 9, (3,))))


def slowly(space: ObservationSpace, value) -> np.ndarray:
    """Return an observation as a vector, after all checks."""
    return space.read(value)[0]


def quickly(space: ObservationSpace, value) -> np.ndarray:
    """Return an observation as a vector, in the way of an environment with many copies."""
    found = space.quick([value])
    return slowly(space, value) if found is None else found[0][0]


@pytest.mark.parametrize(
    ("space", "value", "complaint"),
    [
        (INT64, [0.7, 0.0], "value is 0.7 at index 0, which int64 cannot hold"),
        (BYTES, [0, 300], "value is 300 at index 1, outside its bounds 0 to 255"),
        (BOOLS, [2, 0], "value is 2 at index 0, outside its bounds 0 to 1"),
        (WIDE, [1e300, 0.0], r"value is 1e\+300 at index 0, which float32 cannot hold"),
        (UNIT, [0.0, 1.001], "value is 1.001 at index 1, outside its bounds -1 to 1; env.out_of_bounds=clip moves it "),
        (UNIT, [[0.0, 0.0]], r"value has shape \(1, 2\), but its space has \(2,\)"),
        (UNIT, [[0.0], [0.0, 0.0]], "not numbers"),
        (spaces.Discrete(3), 0.7, r"value is 0.7, outside Discrete\(3\)"),
        (spaces.MultiDiscrete([2, 3]), [1.0, 2.5], r"value is \[1.0, 2.5\], outside MultiDiscrete"),
        (spaces.MultiBinary(2), [1, 2], r"value is \[1, 2\], outside MultiBinary\(2\)"),
        (PARTS, {"a": np.zeros(2), "b": np.zeros(3)}, "without its entry b.c"),
        (PARTS, {"a": np.zeros(2), "b": {"c": [0, 0, 10]}}, "entry b.c is 10 at index 2, outside its bounds -9 to 9"),
        (spaces.Tuple([UNIT, UNIT]), (np.zeros(2),) * 3, "gave an observation of 3 entries, but its space has 2"),
    ],
)  # fmt: skip
def test_a_value_outside_its_space_is_refused_in_a_line_that_names_the_leaf(space, value, complaint):
    for flat in (slowly, quickly):
        with warnings.catch_warnings(), pytest.raises(ProblemError, match=complaint) as raised:
            warnings.simplefilter("error")
            flat(ObservationSpace(space), value)
        assert "\n" not in str(raised.value) and len(str(raised.value)) < 400


@pytest.mark.parametrize(
    ("space", "value", "vector"),
    [
        (INT64, [1.0, -9.0], [1.0, -9.0]),
        (HALVES, [0.5, 65504.0], [0.5, 65504.0]),
        # Rounding: bounds of float64 with values of float32, bounds of float32 with values of float64.
        (spaces.Box(-0.1, 0.3, (2,), np.float64), np.float32([-0.1, 0.3]), np.float32([-0.1, 0.3])),
        (spaces.Box(-0.1, 0.3, (2,)), [-0.1, 0.3], np.float32([-0.1, 0.3])),
        (spaces.Box(-1.0, 1.0, (2,), np.float64), [0.0, 1.0 + 2e-16], [0.0, 1.0 + 2e-16]),
        (spaces.Discrete(3, start=-1), np.bool_(True), [0.0, 0.0, 1.0]),
        (spaces.MultiDiscrete([2, 2], start=[5, 0]), [6.0, 0.0], [0.0, 1.0, 1.0, 0.0]),
        (spaces.Box(-1.0, 1.0, ()), np.float64(0.5), [0.5]),
    ],
)
def test_a_value_inside_its_space_is_accepted_in_any_dtype(space, value, vector):
    assert slowly(ObservationSpace(space), value).tolist() == list(vector)
    assert quickly(ObservationSpace(space), value).tolist() == list(vector)


@pytest.mark.parametrize("out_of_bounds", ["refuse", "clip", "allow"])
@pytest.mark.parametrize("dtype", [np.float16, np.float64, np.int8, np.int64, bool])
@pytest.mark.parametrize("given", [np.float16, np.float64, np.int16, bool])
def test_the_quick_check_of_all_copies_agrees_with_the_check_of_one(out_of_bounds, dtype, given):
    own = spaces.Box(0 if dtype is bool else -1, 1, (3,), dtype)
    parts = spaces.Dict(a=own, b=spaces.Discrete(3, start=-1), c=spaces.MultiDiscrete([2, 3]), d=spaces.MultiBinary(2))
    space = ObservationSpace(parts, None, out_of_bounds)
    numbers = [[0, 1, 1], [-1, 0, 1], [2, 0, -2], [0.5, 0.1, 1.0000001], [np.nan, 0, 0], [np.inf, 0, 0], [1e4, 0, 0]]
    for number, values in enumerate(numbers):
        with np.errstate(invalid="ignore"):
            a, c, d = (np.array(part).astype(given) for part in (values, [number % 3, 2], [1, number % 3]))
        value = {"a": a, "b": number % 4 - 1, "c": c, "d": d}
        assert outcome(slowly, space, value) == outcome(quickly, space, value)


def outcome(flat, space: ObservationSpace, value) -> list[float] | str:
    try:
        return flat(space, value).tolist()
    except ProblemError as error:
        return str(error)


def test_numbers_outside_their_bounds_are_clipped_or_kept_if_asked():
    given = {"clip": [[0.0, 255.0], [-1.0, 1.0]], "allow": [[-1.0, 300.0], [-7.0, 2.5]]}
    for setting, (counts, units) in given.items():
        space = ObservationSpace(spaces.Tuple([BYTES, UNIT]), None, setting)
        assert slowly(space, ([-1, 300], [-7.0, 2.5])).tolist() == counts + units
        with pytest.raises(ProblemError, match=r"entry 0 is 0\.5 at index 0, which uint8 cannot hold"):
            slowly(space, ([0.5, 0], [0.0, 0.0]))
        with pytest.raises(ProblemError, match="entry 1 is nan at index 0, which is not finite"):
            slowly(space, ([0, 0], [np.nan, 0.0]))


def test_bounds_hold_for_resets_and_steps(monkeypatch):
    monkeypatch.setattr(Toy, "_observation", lambda self: np.array([0.0, -1.0 - self.steps]))
    clipped, kept = (make(out_of_bounds=setting) for setting in ("clip", "allow"))
    assert [clipped.reset()["observation"][0, 1], step(clipped)["observation"][0, 1]] == [0.0, 0.0]
    assert [kept.reset()["observation"][0, 1], step(kept)["observation"][0, 1]] == [-1.0, -2.0]
    env = make()
    with pytest.raises(
        ProblemError, match=r"^GymnasiumEnv: .* environment 0: .* value is -1 at index 1, outside its b"
    ):
        env.reset()
    with pytest.raises(ProblemError, match=r"value is -2 at index 1, outside its bounds"):
        step(env)


def test_bounds_of_any_size_give_no_warning():
    low = np.array([-np.inf, -1e308, 0.0, np.inf, -np.inf])
    high = np.array([np.inf, 1e308, np.inf, np.inf, -np.inf])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for space in (spaces.Box(low, high, dtype=np.float64), spaces.Box(-np.inf, np.inf, (5,))):
            assert ObservationScaling(ObservationSpace(space), "bounds").scaled(np.ones((1, 5))).tolist() == [[1.0] * 5]
