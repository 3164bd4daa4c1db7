"""The rules of the boat-docking environment that was released with the benchmark's paper, as pure functions on columns.

Source: the code released with *A Benchmark for Hierarchical Parameterized Action Markov Decision Process*. Every
oddity is that code's own. What it computes but what can't happen is left out: it also ends episodes more than 125 px
from the centre, and at walls on the right and below, but holds the boat within 109 px of the centre and short of both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import counter_rng

OUTCOMES = ("sailing", "success", "wall", "out_of_fuel", "time_limit")
SAILING, SUCCESS, WALL, OUT_OF_FUEL, TIME_LIMIT = range(5)
OBSERVATION_NAMES = (
    *("start_x", "start_y", "goal_x", "goal_y", "centre_x", "centre_y", "radius", "controller", "keymap"),
    *("boat_x", "boat_y", "velocity_x", "velocity_y", "fuel", "distance"),
)
SCALED_NAMES = (*OBSERVATION_NAMES, "to_goal_x", "to_goal_y")

# Screen px. Start and goal are whole numbers in [LOW, LOW + SIZE), the boat is held in [LOW, HIGH].
CENTRE, RADIUS = (640.0, 512.0), 120.0
LOW, HIGH, SIZE = (563.0, 435.0), (707.0, 579.0), 154
MIN_SEPARATION, DOCK = 100.0, 10.0
TANK, EMPTY, SUCCESS_REWARD = 5.0, 1e-6, 10.0
_FRAME, NO_KEYMAP = 0.02, -1
_COS30 = 0.866  # sic
# By key map (the congruent boat has one only) and key.
DIRECTIONS = {
    "congruent": (((-_COS30, 0.5), (0.0, -1.0), (_COS30, 0.5)),),
    "incongruent": (
        ((0.0, 1.0), (_COS30, -0.5), (-_COS30, -0.5)),
        ((_COS30, -0.5), (-_COS30, -0.5), (0.0, 1.0)),
    ),
}
# What the test modes tell apart: bearings (y down) within 30 degrees of one of these, or not.
_TEST_BEARINGS = ((0.0, 1.0), (-math.sqrt(3.0) / 2.0, -0.5), (math.sqrt(3.0) / 2.0, -0.5))
# Draws of an episode's key: the key map, then four for each try at a layout, tried many at once.
DRAW_KEYMAP, _DRAW_LAYOUT, _TRIES = 0, 1, 32


class ReleasedState(NamedTuple):
    """Columns `[num_envs]`; x and y are where the boat is *shown*, at the raw start until the first move.

    `episode` is -1 before an environment's first reset, when it has no layout yet.
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


def draw_layouts(rng: Tensor, test_mode: int | None) -> Tensor:
    """Draw starts and goals `[M, 4]` (screen px, float64), again while they are too close or of the other test mode.

    Args:
        rng: int32 `[M]` from `counter_rng.key_for`.
        test_mode: see `ReleasedBoatDockEnv`.
    """
    low = torch.tensor([*LOW, *LOW], dtype=torch.float64, device=rng.device)
    layout = low.repeat(len(rng), 1)
    missing, first = torch.arange(len(rng), device=rng.device), _DRAW_LAYOUT
    while len(missing):
        draw = first + torch.arange(4 * _TRIES, dtype=torch.int32, device=rng.device)
        numbers = counter_rng.uniform(rng[missing].unsqueeze(-1), draw).double()
        points = low + (SIZE * numbers).floor().unflatten(-1, (_TRIES, 4))
        is_good = (points[..., :2] - points[..., 2:]).norm(dim=-1) >= MIN_SEPARATION
        if test_mode is not None:
            is_good &= is_within_30_degrees(points) == bool(test_mode)
        found, at = is_good.max(-1)
        layout[missing[found]] = points[found, at[found]]
        missing, first = missing[~found], first + 4 * _TRIES
    return layout


def is_within_30_degrees(points: Tensor) -> Tensor:
    """Return whether layouts `[*B, 4]`, clamped as the boat is, have a bearing that test mode 1 asks for."""
    bounds = [torch.tensor([*corner, *corner], dtype=points.dtype, device=points.device) for corner in (LOW, HIGH)]
    points = points.clamp(*bounds)
    bearing = torch.nn.functional.normalize(points[..., 2:] - points[..., :2], dim=-1)
    cosines = bearing @ torch.tensor(_TEST_BEARINGS, dtype=points.dtype, device=points.device).T
    # Exactly 30 degrees, which of all bearings the level ones are, count as outside.
    return cosines.amax(-1) > math.cos(math.radians(30.0)) + 1e-9


def reach(seconds: Tensor) -> Tensor:
    """Return how far presses carry, px: forwards up to .3 s, beyond it ever further backwards."""
    frames = seconds / _FRAME
    return 10.0 * _FRAME * frames.square() * (10.0 - 0.6667 * frames)


def press(state: ReleasedState, direction: Tensor, duration: Tensor, max_steps: int) -> tuple[ReleasedState, Tensor]:
    """Press for `duration` (u, float32 `[N]`) along `direction` `[N, 2]`; return the next states and rewards `[N]`."""
    # Rounded in float32, in this order, whatever the type of all else.
    seconds = ((duration + 1.0) / 2.0 * 5.0).to(state.fuel)
    distance = reach(seconds)
    dir_x, dir_y = direction.unbind(-1)
    x = (state.x.clamp(LOW[0], HIGH[0]) + dir_x * distance).clamp(LOW[0], HIGH[0])
    y = (state.y.clamp(LOW[1], HIGH[1]) + dir_y * distance).clamp(LOW[1], HIGH[1])
    fuel, steps = state.fuel - duration.to(state.fuel), state.steps + 1

    is_docked = (x - state.goal_x.clamp(LOW[0], HIGH[0])).abs() <= DOCK
    is_docked &= (y - state.goal_y.clamp(LOW[1], HIGH[1])).abs() <= DOCK
    outcome = torch.where(is_docked, SUCCESS, SAILING)
    # The first that holds counts, so the last to be asked here.
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
    """Return the shown boats' distance to their goals as a share of the starts', `[N]`."""
    to_goal = torch.hypot(state.goal_x - state.x, state.goal_y - state.y)
    at_start = torch.hypot(state.goal_x - state.start_x, state.goal_y - state.start_y)
    return to_goal / at_start.clamp(min=1.0)  # whole pixels apart, but before the first reset


def observe(state: ReleasedState, is_congruent: bool, is_scaled: bool) -> Tensor:
    """Return the observation, whose entries are OBSERVATION_NAMES or SCALED_NAMES."""
    ones = torch.ones_like(state.fuel)
    centre = (0.0, 0.0) if is_scaled else CENTRE
    length, speed, radius = (SIZE / 2.0, 50.0, 1.0) if is_scaled else (1.0, 1.0, RADIUS)

    def place(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        return ((x - CENTRE[0]) / length, (y - CENTRE[1]) / length) if is_scaled else (x, y)

    fuel = state.fuel / TANK
    columns = [
        *place(state.start_x, state.start_y),
        *place(state.goal_x, state.goal_y),
        *(ones * centre[0], ones * centre[1], ones * radius),
        *(ones * is_congruent, state.keymap.to(ones)),
        *place(state.x, state.y),
        *(state.velocity_x / speed, state.velocity_y / speed),
        *(fuel.clamp(min=0.0).log1p() if is_scaled else fuel, _distance(state)),
    ]
    if is_scaled:
        columns += [(state.goal_x - state.x) / length, (state.goal_y - state.y) / length]
    return torch.stack(columns, -1)
