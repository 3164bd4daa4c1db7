"""Spaces of Gymnasium are read as documented, and all others are refused in one line."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.spaces import Box, Dict, Discrete, Graph, MultiDiscrete, OneOf, Sequence, Text, Tuple
from toy_environments import FORMS, MIXED

from hpamdp import messages
from hpamdp.env.gymnasium.action_spaces import ActionSpace
from hpamdp.env.gymnasium.observation_spaces import ObservationSpace
from hpamdp.env.gymnasium.scaling import ObservationScaling

UNIT = Box(0, 1, (1,))
MANY = 1 << 31


@pytest.mark.parametrize(
    ("space", "reason"),
    [
        (Text(5), "has a Text"),
        (Tuple([Discrete(3), Dict(a=UNIT, b=Sequence(UNIT))]), "has a Sequence"),
        (OneOf([UNIT, Graph(UNIT, None)]), "has a Graph"),
        (Tuple([Dict(), Tuple([])]), "has nothing to choose"),
        (Tuple([Discrete(2), Box(0, np.inf, (40, 2))]), "parameters must have finite bounds"),
        (Tuple([Discrete(2), Box(-1e308, 1e308, (2,), dtype=np.float64)]), "parameters must have finite bounds"),
        (Box(0, 2**60, (2,), dtype=np.int64), "parameters must have finite bounds, at most 9e15 for whole numbers"),
        (Tuple([Discrete(2), Box(1.7e9, 1.7e9, (2,), dtype=np.float64)]), "a parameter's lower bound must be less"),
        (Tuple([Discrete(2), Box(1, 1, (2,))]), "a parameter's lower bound must be less than its upper bound"),
    ],
    ids=str,
)
def test_another_action_space_is_refused_in_one_line(space, reason):
    with pytest.raises(ValueError) as raised:
        ActionSpace(space)
    line = str(raised.value)
    assert line.startswith(f"action space {type(space).__name__}(") and "\n" not in line and len(line) < 700
    assert f": {reason}" in line and "; accepted are trees of Discrete, MultiDiscrete, " in line


def native(space: ActionSpace, discrete: int, parameters) -> tuple:
    (action,) = space.to_native(np.array([discrete]), np.float32([parameters]))
    return action


@pytest.mark.parametrize(
    ("space", "sizes", "dims"),
    [
        (Dict(mode=Discrete(2), count=Discrete(MANY)), (2, 1), (0, 0, 1)),
        (Dict(count=Discrete(MANY, start=-5), x=UNIT), (), (1, 1)),
        (Discrete(MANY), (), (1,)),
        (MultiDiscrete([MANY, 3]), (), (2,)),
        (Discrete(1000), (), (0,) * 1000),
    ],
    ids=str,
)
def test_entries_with_very_many_values_are_read_as_ordered_numbers_with_a_warning(space, sizes, dims, capsys):
    messages.warn_once.cache_clear()
    read = ActionSpace(space)
    assert sorted(read.component_sizes) == sorted(sizes) or not sizes
    assert sorted(read.parameter_dims) == sorted(dims)
    choice = np.zeros((1, read.num_components) if read.component_sizes else 1, np.int64)
    assert read.to_native(choice, read.high[None].astype(float))[0] in space
    told = capsys.readouterr().err
    assert ("has more than 1,000 values, so it is an ordered parameter" in told) == (len(dims) < 1000)


def test_observed_entries_with_very_many_values_are_numbers():
    space = ObservationSpace(Dict(m=MultiDiscrete([MANY, 3]), n=Discrete(MANY, start=4)))
    assert space.read({"m": np.array([7, 2]), "n": np.int64(5)})[0].tolist() == [7.0, 2.0, 5.0]
    assert space.quick([{"m": np.array([9, 1]), "n": np.array(6)}])[0].tolist() == [[9.0, 1.0, 6.0]]


@pytest.mark.parametrize(("high", "is_told"), [(500_000.0, True), (2.0, False), (np.inf, False)])
def test_bounds_far_wider_than_what_is_seen_are_told_once(high, is_told, capsys):
    space = Dict(mode=Discrete(3), position=Box(-50_000.0 if is_told else -2.0, high, (2,)))
    scaling = ObservationScaling(ObservationSpace(space), "bounds")
    seen = np.linspace([0.0, 0.0, 0.0, -3e-3, -3e-3], [0.0, 0.0, 1.0, 3e-3, 3e-3], 8)
    for _ in range(500):
        scaling.scaled(seen)
    (*lines,) = capsys.readouterr().err.splitlines()
    assert len(lines) == is_told
    assert all("observation position[0]: seen from -0.003 to " in line for line in lines)
    assert all("use env.observation_scaling=running" in line for line in lines)


@pytest.mark.parametrize(
    ("low", "high"), [(1.7e9, 1.7e9 + 3600.0), (-5e4, -5e4 + 1e-3), (0.0, 1e-320), (1e30, 1e30 + 1e20), (99.0, 100.0)]
)
def test_bounds_that_float32_cannot_resolve_are_reached_in_float64(low, high):
    wide, narrow = Box(low, high, (1,), np.float64), Box(-3.0, 5.0, (1,), np.float64)
    space = ActionSpace(Tuple([Discrete(2), Tuple([narrow, wide])]))
    assert space.parameter_dims == (1, 1)
    assert space.low.tolist() == [-3.0, -1.0] and space.high.tolist() == [5.0, 1.0]
    units = np.linspace(-1.0, 1.0, 3601, dtype=np.float32)
    values = np.array([native(space, 1, [0.5, unit])[1][1][0] for unit in units])
    assert values[0] == low and values[-1] == high and values.dtype == np.float64
    exact = low + 0.5 * (units.astype(np.float64) + 1.0) * (high - low)
    np.testing.assert_allclose(
        values - low, exact - low, rtol=0, atol=1e-6 * (high - low) + np.spacing(max(-low, high))
    )
    if high - low > 1e-300:
        assert len(np.unique(values)) == 3601
    others = {-np.inf: low, np.inf: high, 9.0: high, np.nan: low}
    assert all(native(space, 1, [9.0, given])[1][1][0] == value for given, value in others.items())
    assert native(space, 0, [9.0, 0.0])[1][0] == 5.0


def test_bounds_that_float32_resolves_are_passed_as_they_are():
    boxes = [Box(-1.0, 1.0, (1,), np.float64), Box(1.7e9, 1.7e9 + 4096, (1,)), Box(0, 1, (1,), np.float16)]
    space = ActionSpace(Tuple([Discrete(3), Tuple(boxes)]))
    assert space.low.tolist() == [-1.0, np.float32(1.7e9), 0.0]
    given = np.float32([0.123, 1.7e9 + 256, 0.25])
    values = [part[0] for part in native(space, 0, given)[1]]
    assert values == given.tolist()


def test_the_sizes_of_a_split_box_must_add_up():
    for wrong in ([1, 1, 2], [3], [4, -1, 0], []):
        with pytest.raises(ValueError, match=r"must be 3 numbers of at least 0 that add up to 3"):
            ActionSpace(FORMS["split"][0], wrong)
    with pytest.raises(ValueError, match="is for one Box for all discrete actions"):
        ActionSpace(FORMS["nested"][0], [2, 0, 1])
    for space, form in ((Tuple([Discrete(2), Discrete(2), UNIT]), "auto"), (FORMS["split"][0], "components")):
        with pytest.raises(ValueError, match="is for one Box for all discrete actions, but there is none"):
            ActionSpace(space, [2, 0, 1], form)


def test_boxes_in_a_dict_belong_to_the_discrete_actions_in_its_order_unless_all_are_numbered():
    def sizes(**boxes: int) -> tuple[int, ...]:
        parts = [(name, spaces.Box(0.0, 1.0, (size,))) for name, size in boxes.items()]
        space = spaces.Dict(key=spaces.Discrete(3), of=spaces.Dict(parts))
        return ActionSpace(space).parameter_dims

    assert sizes(go=1, at=2, by=3) == (1, 2, 3)
    assert sizes(go10=1, at9=2, by8=3) == (3, 2, 1)
    assert sizes(go10=1, at9=2, by=3) == (1, 2, 3)
    assert sizes(go1=1, at1=2, by0=3) == (1, 2, 3)


def test_observations_are_flattened():
    value = (np.array([[1.5], [-2.0]], np.float32), np.int64(2), {"a": np.array([1, 0], np.int8)})
    space = ObservationSpace(MIXED)
    plain, scaled = (ObservationScaling(space, scaling) for scaling in ("none", "bounds"))
    assert plain.scaled(space.read(value)[0][None]).tolist() == [[1.5, -2.0, 0.0, 1.0, 0.0, 1.0, 0.0]]
    assert scaled.scaled(space.read(value)[0][None]).tolist() == [[0.75, -1.0, -1.0, 1.0, -1.0, 1.0, -1.0]]


def test_entries_without_bounds_stay_as_they_are():
    low = np.array([0.0, -np.inf, -3.4e38, -1.0, -1e10, 5.0, 1e5])
    high = np.array([4.0, 1.0, 3.4e38, np.inf, 1e10, 5.0, 1.00001e5])
    for dtype in (np.float32, np.float64):
        space = ObservationSpace(spaces.Box(low.astype(dtype), high.astype(dtype), dtype=dtype))
        seen = ObservationScaling(space, "bounds").scaled(
            np.array([[1.0, 7.0, 7.0, 7.0, 7.0, 5.0, 1e5], [9.0, 7.0, 7.0, 7.0, 7.0, 5.0, 1e5]])
        )
        assert seen.tolist() == [[-0.5, 7.0, 7.0, 7.0, 7.0, 5.0, -1.0], [3.5, 7.0, 7.0, 7.0, 7.0, 5.0, -1.0]]
    image = ObservationSpace(spaces.Box(0, 255, (2, 2), np.uint8))
    seen = ObservationScaling(image, "bounds").scaled(image.read(np.array([[0, 255], [0, 255]], np.uint8))[0][None])
    assert seen.tolist() == [[-1.0, 1.0, -1.0, 1.0]]


def test_running_statistics_keep_the_unit_of_constant_entries_and_clip():
    space = ObservationScaling(ObservationSpace(spaces.Box(-np.inf, np.inf, (2,))), "running")
    for _ in range(300):
        assert space.scaled(np.array([[3.0, 1e8]])).tolist() == [[0.0, 0.0]]
    assert space.scaled(np.array([[4.0, 1e8]]))[0].tolist() == [10.0, 0.0]
