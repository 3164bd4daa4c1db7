"""The rules of the boat-docking environment released with the benchmark's paper, as pure functions on columns.

Source: the code released with *A Benchmark for Hierarchical Parameterized Action Markov Decision Process*. All oddities
are that code's own.
Differs from the source: rules that can never apply are left out. The released code also ends episodes more than 125 px
from the centre, and at the right and lower walls. But it keeps the boat within 109 px of the centre and off these
walls.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.boatdock import task

OUTCOMES = ("sailing", "success", "wall", "out_of_fuel", "time_limit")
SAILING, SUCCESS, WALL, OUT_OF_FUEL, TIME_LIMIT = range(5)
OBSERVATION_NAMES = (*task.OBSERVATION_NAMES[:8], "keymap", *task.OBSERVATION_NAMES[8:])
SCALED_NAMES = (*OBSERVATION_NAMES, "to_goal_x", "to_goal_y")

# Screen px. Start and goal are integers in [LOW, LOW + SIZE); the boat is clamped to [LOW, HIGH].
CENTRE = (640.0, 512.0)
RADIUS = 120.0
LOW = (563.0, 435.0)
HIGH = (707.0, 579.0)
SIZE = 154
MIN_SEPARATION = 100.0
DOCK = 10.0  # half the side of the square around the goal in which a boat docks
TANK = 5.0
EMPTY = 1e-6  # the tank counts as empty at or below this
SUCCESS_REWARD = 10.0
NO_KEYMAP = -1  # the key map that the congruent boat observes
_TICK = 0.02  # seconds
_COS30 = 0.866  # rounded in the released code
# Directions by key map and key. The congruent boat has only one key map.
DIRECTIONS = {
    "congruent": (((-_COS30, 0.5), (0.0, -1.0), (_COS30, 0.5)),),
    "incongruent": (
        ((0.0, 1.0), (_COS30, -0.5), (-_COS30, -0.5)),
        ((_COS30, -0.5), (-_COS30, -0.5), (0.0, 1.0)),
    ),
}
# Test mode 1 keeps the layouts whose bearing (y down) lies within 30 degrees of one of these.
_TEST_BEARINGS = ((0.0, 1.0), (-math.sqrt(3.0) / 2.0, -0.5), (math.sqrt(3.0) / 2.0, -0.5))
# Indices of an episode's random numbers: one for the key map, then four for each candidate layout.
INDEX_KEYMAP = 0
_INDEX_LAYOUT = 1
_TRIES = 32  # candidate layouts that are sampled together


class ReleasedState(NamedTuple):
    """The state of N boats, columns `[N]`.

    `x` and `y` are the *displayed* position. Until the first move it is the start, even if that lies outside the boat's
    bounds. `episode` is -1 before an environment's first reset, when it has no layout yet.
    """

    start_x: Tensor
    start_y: Tensor
    goal_x: Tensor
    goal_y: Tensor
    x: Tensor
    y: Tensor
    velocity_x: Tensor
    velocity_y: Tensor
    fuel: Tensor
    keymap: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


def sample_layouts(rng: counter_rng.RngKey, test_mode: int | None) -> Tensor:
    """Sample starts and goals `[M, 4]` (screen px, float64) that are far enough apart and match the test mode.

    Args:
        rng: random-number keys `[M]` from `counter_rng.rng_key`.
        test_mode: the setting of `ReleasedBoatDockEnv`.
    """
    low = torch.tensor([*LOW, *LOW], dtype=torch.float64, device=rng.bits.device)
    layout = low.repeat(len(rng.bits), 1)
    missing = torch.arange(len(rng.bits), device=rng.bits.device)
    first = _INDEX_LAYOUT
    while len(missing):
        index = first + torch.arange(4 * _TRIES, dtype=torch.int32, device=rng.bits.device)
        keys = rng._replace(bits=rng.bits[missing].unsqueeze(-1))
        numbers = counter_rng.uniform(keys, index).double()
        points = low + (SIZE * numbers).floor().unflatten(-1, (_TRIES, 4))
        is_good = (points[..., :2] - points[..., 2:]).norm(dim=-1) >= MIN_SEPARATION
        if test_mode is not None:
            is_good &= is_within_30_degrees(points) == bool(test_mode)
        is_found, first_good = is_good.max(-1)
        layout[missing[is_found]] = points[is_found, first_good[is_found]]
        missing = missing[~is_found]
        first += 4 * _TRIES
    return layout


def is_within_30_degrees(points: Tensor) -> Tensor:
    """Return whether layouts `[*B, 4]`, clamped to the boat's bounds, belong to test mode 1."""
    low = torch.tensor([*LOW, *LOW], dtype=points.dtype, device=points.device)
    high = torch.tensor([*HIGH, *HIGH], dtype=points.dtype, device=points.device)
    points = points.clamp(low, high)
    bearing = torch.nn.functional.normalize(points[..., 2:] - points[..., :2], dim=-1)
    cosines = bearing @ torch.tensor(_TEST_BEARINGS, dtype=points.dtype, device=points.device).T
    # Horizontal bearings are off by exactly 30 degrees. They count as outside.
    return cosines.amax(-1) > math.cos(math.radians(30.0)) + 1e-9


def reach(seconds: Tensor) -> Tensor:
    """Return the distance (px) that a press moves the boat.

    It is positive up to 0.3 s. Longer presses move the boat backwards, the longer the further.
    """
    ticks = seconds / _TICK
    return 10.0 * _TICK * ticks.square() * (10.0 - 0.6667 * ticks)


def press(state: ReleasedState, direction: Tensor, parameter: Tensor, max_steps: int) -> tuple[ReleasedState, Tensor]:
    """Return the states after a press, and the rewards `[N]`.

    Args:
        state: states before the press.
        direction: unit direction of the key, `[N, 2]`.
        parameter: u in [-1, 1], float32 `[N]`. The press takes 2.5 (u + 1) seconds.
        max_steps: steps after which an episode is truncated.
    """
    # As released, the duration is rounded in float32 and in this order, whatever the dtype of the state.
    seconds = ((parameter + 1.0) / 2.0 * 5.0).to(state.fuel)
    distance = reach(seconds)
    dir_x, dir_y = direction.unbind(-1)
    x = (state.x.clamp(LOW[0], HIGH[0]) + dir_x * distance).clamp(LOW[0], HIGH[0])
    y = (state.y.clamp(LOW[1], HIGH[1]) + dir_y * distance).clamp(LOW[1], HIGH[1])
    fuel = state.fuel - parameter.to(state.fuel)  # as released: the parameter, not the seconds, is subtracted
    steps = state.steps + 1

    is_docked = (x - state.goal_x.clamp(LOW[0], HIGH[0])).abs() <= DOCK
    is_docked &= (y - state.goal_y.clamp(LOW[1], HIGH[1])).abs() <= DOCK
    outcome = torch.where(is_docked, SUCCESS, SAILING)
    # If several outcomes apply, the last one counts.
    outcome = torch.where((x <= LOW[0]) | (y <= LOW[1]), WALL, outcome)
    outcome = torch.where(fuel <= EMPTY, OUT_OF_FUEL, outcome)
    outcome = torch.where(steps >= max_steps, TIME_LIMIT, outcome).to(state.outcome)

    is_sailing = outcome == SAILING
    after = state._replace(
        x=torch.where(is_sailing, x, state.x),
        y=torch.where(is_sailing, y, state.y),
        velocity_x=10.0 * seconds * dir_x,
        velocity_y=10.0 * seconds * dir_y,
        fuel=fuel,
        steps=steps,
        outcome=outcome,
    )
    reward = torch.where(is_sailing, _distance(state) - _distance(after), 0.0)
    reward = torch.where(outcome == SUCCESS, SUCCESS_REWARD * fuel / TANK, reward)
    return after, torch.where(outcome == OUT_OF_FUEL, -1.0, reward)


def _distance(state: ReleasedState) -> Tensor:
    """Return the displayed boats' distance to the goal as a fraction of the distance at the start, `[N]`."""
    to_goal = torch.hypot(state.goal_x - state.x, state.goal_y - state.y)
    at_start = torch.hypot(state.goal_x - state.start_x, state.goal_y - state.start_y)
    return to_goal / at_start.clamp(min=1.0)  # the clamp acts only before the first reset


def observe(state: ReleasedState, is_congruent: bool, is_scaled: bool) -> Tensor:
    """Return the observation with the entries OBSERVATION_NAMES or, if scaled, SCALED_NAMES."""
    ones = torch.ones_like(state.fuel)
    fuel = state.fuel / TANK
    if is_scaled:
        length = SIZE / 2.0
        speed = 50.0
        columns = [
            (state.start_x - CENTRE[0]) / length,
            (state.start_y - CENTRE[1]) / length,
            (state.goal_x - CENTRE[0]) / length,
            (state.goal_y - CENTRE[1]) / length,
            ones * 0.0,
            ones * 0.0,
            ones,
            ones * is_congruent,
            state.keymap.to(ones),
            (state.x - CENTRE[0]) / length,
            (state.y - CENTRE[1]) / length,
            state.velocity_x / speed,
            state.velocity_y / speed,
            fuel.clamp(min=0.0).log1p(),
            _distance(state),
            (state.goal_x - state.x) / length,
            (state.goal_y - state.y) / length,
        ]
    else:
        columns = [
            state.start_x,
            state.start_y,
            state.goal_x,
            state.goal_y,
            ones * CENTRE[0],
            ones * CENTRE[1],
            ones * RADIUS,
            ones * is_congruent,
            state.keymap.to(ones),
            state.x,
            state.y,
            state.velocity_x,
            state.velocity_y,
            fuel,
            _distance(state),
        ]
    return torch.stack(columns, -1)
