"""A player that knows the map: the moves with the highest return on a grid, by value iteration.

Its moves are one to five spacings of a grid of 100 x 100 points, on which the start lies. So from the start it never
leaves the grid, slips included, and its values are exact. From other positions it takes the values of the grid points
that are nearest to where its moves end.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor

from hpamdp.env.office import rules
from hpamdp.env.office.options import GOALS
from hpamdp.env.office.rules import OfficeState

_SIZE = 100  # grid points along an axis
_BEFORE_START = 5  # grid points before the start, along an axis
# Less than a hundredth, so that no grid point lies on the edge of a wall or of a place, where rounding would decide.
_SPACING = 0.00999
_NUM_LENGTHS = 5  # of each move
_SLIPPED = (rules.LEFT, rules.RIGHT, rules.UP, rules.DOWN)  # what each move slips to
_IN_A_WALL = -1e6  # the value of grid points that no move ends at
_TOLERANCE = 1e-6  # of the values


def plan(state: OfficeState, slip: float, *, chooses_goal: bool) -> tuple[Tensor, Tensor]:
    """Return the best moves and their lengths: `[N, 1]` each, or `[N, 3]` if there are options, one for each.

    Args:
        state: states of N environments.
        slip: probability that a move slips to the other axis.
        chooses_goal: whether the agent chooses its goal as an option.
    """
    values = best_values(slip, chooses_goal).to(state.x.device)
    discrete, length = (each.to(state.x.device) for each in _moves(state.x.dtype))
    best = []
    for option in range(len(values)):
        after, reward = _act(state, option if chooses_goal else None)
        following = _with_best(values)[_places(state, after, option, len(values))]
        best.append(_expected(reward + following, slip).argmax(0))
    chosen = torch.stack(best, -1)
    return discrete[chosen], length[chosen]


@cache
def best_values(slip: float, chooses_goal: bool) -> Tensor:
    """Return the highest expected returns from the grid points, float64 `[options, held, rows * columns]`.

    The option is held until its goal is reached; then the best one follows. Without options, the first dimension is 1.
    The place in the second one is 1 with the coffee, plus 2 with the mail. There is no time limit.
    """
    num_options = len(GOALS) if chooses_goal else 1
    held, row, column = (
        part.flatten() for part in torch.meshgrid(torch.arange(4), *[torch.arange(_SIZE)] * 2, indexing="ij")
    )
    none = torch.zeros_like(held, dtype=torch.int32)
    x, y = (
        at + _SPACING * (place - _BEFORE_START).double() for at, place in zip(rules.START, (column, row), strict=True)
    )
    state = OfficeState(x, y, (held & 1).int(), (held >> 1).int(), none, none, none)
    is_wall = rules.is_refused(x, y, x, y)
    rewards, places = [], []
    for option in range(num_options):
        after, reward = _act(state, option if chooses_goal else None)
        rewards.append(reward)
        places.append(_places(state, after, option, num_options))
    values = torch.zeros(num_options, 4, _SIZE * _SIZE, dtype=torch.float64)
    while True:
        known = _with_best(values)
        best = [_expected(reward + known[place], slip).amax(0) for reward, place in zip(rewards, places, strict=True)]
        better = torch.stack(best).masked_fill(is_wall, _IN_A_WALL).reshape(values.shape)
        if torch.allclose(better, values, rtol=0.0, atol=_TOLERANCE):
            return better
        values = better


def _moves(dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return the player's 20 moves and their lengths, `[20]` each."""
    discrete = torch.arange(len(rules.ACTIONS)).repeat_interleave(_NUM_LENGTHS)
    lengths = _SPACING * torch.arange(1, _NUM_LENGTHS + 1, dtype=dtype)
    sign = torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=dtype)
    return discrete, (sign.unsqueeze(-1) * lengths).flatten()


def _act(state: OfficeState, option: int | None) -> tuple[OfficeState, Tensor]:
    """Return the states after each move without a slip, and the rewards, `[20, N]`."""
    discrete, length = (each.to(state.x.device).unsqueeze(-1) for each in _moves(state.x.dtype))
    num = len(discrete)
    before = OfficeState(*(column.expand(num, -1) for column in state))
    options = None if option is None else torch.full_like(before.steps, option, dtype=torch.long)
    slips = torch.zeros_like(before.steps, dtype=torch.bool)
    return rules.act(before, discrete.expand_as(slips), length.expand_as(slips), slips, options)


def _with_best(values: Tensor) -> Tensor:
    """Return the values of all options one after another, then those of the best one, then 0 for what is over."""
    return torch.cat([values.flatten(), values.amax(0).flatten(), values.new_zeros(1)])


def _places(before: OfficeState, after: OfficeState, option: int, num_options: int) -> Tensor:
    """Return the places in `_with_best` of what follows moves under an option, `[20, N]`."""
    column, row = (
        (_BEFORE_START + (part - at) / _SPACING).round().long().clamp(0, _SIZE - 1)
        for at, part in zip(rules.START, (after.x, after.y), strict=True)
    )
    held = after.coffee.long() + 2 * after.mail.long()
    has_taken = (after.coffee != before.coffee) | (after.mail != before.mail)
    table = torch.where(has_taken, num_options, option)
    place = ((table * 4 + held) * _SIZE + row) * _SIZE + column
    return torch.where(after.outcome == rules.DELIVERED, (num_options + 1) * 4 * _SIZE * _SIZE, place)


def _expected(value: Tensor, slip: float) -> Tensor:
    """Return the expected values of the moves, `[20, N]`, from their values without a slip."""
    slipped = value.unflatten(0, (len(rules.ACTIONS), _NUM_LENGTHS))[list(_SLIPPED)].flatten(0, 1)
    return (1.0 - slip) * value + slip * slipped
