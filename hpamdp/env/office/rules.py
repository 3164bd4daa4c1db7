"""The numbers of Office, and a move as pure functions on columns, in the dtype of the state.

Source: the Office domain of PEARL, AAAI 2026, arXiv:2512.20831, with the map, constants and rules of its code.

Differs from the source:
- Observations are scaled to [-1, 1].
- With `tiles` the observation also has the position as tiles.
- With `chooses_goal` the agent chooses as an option what it goes for next, and takes nothing else.

y grows downwards. The length of a move bears its sign: `up` and `left` have lengths in [-0.05, 0], `down` and `right`
in [0, 0.05]. A slip keeps the length with its sign, so `up` slips to the left and `down` to the right.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env.office.options import GOALS

UP, DOWN, LEFT, RIGHT = range(4)
ACTIONS = ("up", "down", "left", "right")
LONGEST = 0.05  # the longest move
PARAMETER_LOW, PARAMETER_HIGH = (-LONGEST, 0.0, -LONGEST, 0.0), (0.0, LONGEST, 0.0, LONGEST)
OUTCOMES = ("on the way", "delivered", "time limit")
ON_THE_WAY, DELIVERED, TIME_LIMIT = range(3)
OBSERVATION_NAMES = ("y", "x", "has_coffee", "has_mail")
COFFEE, MAIL, TARGET = range(3)
START = (0.05, 0.05)  # x, y
PLACES = ((0.8, 0.1), (0.55, 0.54), (0.95, 0.95))  # x, y of the coffee, the mail and the target
REACH = 0.06  # how near, on both axes, the agent must come to a place
STEP_REWARD, REFUSED_REWARD, TAKEN_REWARD, DELIVERED_REWARD = -1.0, -2.0, 0.0, 1000.0

# Walls as (left, right, top, bottom): the borders, then the upright ones and the level ones inside. Nine rooms, with a
# door to each neighbour. One door of the source is a hundredth wider than the others.
WALLS = (
    *((0.0, 0.01, 0.0, 1.0), (0.99, 1.0, 0.0, 1.0), (0.0, 1.0, 0.0, 0.01), (0.0, 1.0, 0.99, 1.0)),
    *((0.32, 0.33, 0.0, 0.1), (0.32, 0.33, 0.2, 0.45), (0.32, 0.33, 0.55, 0.8), (0.32, 0.33, 0.9, 1.0)),
    *((0.66, 0.67, 0.0, 0.1), (0.66, 0.67, 0.2, 0.44), (0.66, 0.67, 0.55, 0.8), (0.66, 0.67, 0.9, 1.0)),
    *((0.0, 0.1, 0.32, 0.33), (0.2, 0.45, 0.32, 0.33), (0.55, 0.8, 0.32, 0.33), (0.9, 1.0, 0.32, 0.33)),
    *((0.0, 0.1, 0.66, 0.67), (0.2, 0.45, 0.66, 0.67), (0.55, 0.8, 0.66, 0.67), (0.9, 1.0, 0.66, 0.67)),
)


class OfficeState(NamedTuple):
    """The state of N environments, columns `[N]`.

    It holds the agent's position, whether it has the coffee and the mail (int32, 0 or 1), and int32 counters.
    """

    x: Tensor
    y: Tensor
    coffee: Tensor
    mail: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


def act(
    state: OfficeState, discrete: Tensor, length: Tensor, slips: Tensor, option: Tensor | None = None
) -> tuple[OfficeState, Tensor]:
    """Return the states after one move in every environment, and the rewards, `[N]`.

    Args:
        state: states before the move.
        discrete: UP, DOWN, LEFT or RIGHT, `[N]`.
        length: length of the move with its sign, `[N]`.
        slips: whether the move slips to the other axis, bool `[N]`.
        option: goals that the agents have chosen, `[N]`. If None, they take whatever they reach.
    """
    is_upright = (discrete <= DOWN) ^ slips
    x = torch.where(is_upright, state.x, state.x + length)
    y = torch.where(is_upright, state.y + length, state.y)
    refused = is_refused(state.x, state.y, x, y)
    x, y = torch.where(refused, state.x, x), torch.where(refused, state.y, y)
    may_take = open_goals(state)
    if option is not None:
        goal = goal_in_mind(may_take, option)
        may_take = may_take & (goal.unsqueeze(-1) == torch.arange(len(GOALS), device=goal.device))
    coffee, mail, target = (may_take[..., goal] & is_near(x, y, goal) & ~refused for goal in (COFFEE, MAIL, TARGET))
    mail = mail & ~coffee
    reward = torch.where(coffee | mail, TAKEN_REWARD, torch.where(target, DELIVERED_REWARD, STEP_REWARD))
    reward = torch.where(refused, REFUSED_REWARD, reward).to(length.dtype)
    after = OfficeState(
        x,
        y,
        state.coffee | coffee.int(),
        state.mail | mail.int(),
        state.steps + 1,
        torch.where(target, DELIVERED, ON_THE_WAY).int(),
        state.episode,
    )
    return after, reward


def is_refused(x: Tensor, y: Tensor, to_x: Tensor, to_y: Tensor) -> Tensor:
    """Return which moves along an axis touch a wall or leave [0, 1), bool `[*B]`."""
    left, right = torch.minimum(x, to_x), torch.maximum(x, to_x)
    top, bottom = torch.minimum(y, to_y), torch.maximum(y, to_y)
    refused = (left < 0.0) | (right >= 1.0) | (top < 0.0) | (bottom >= 1.0)
    for wall_left, wall_right, wall_top, wall_bottom in WALLS:
        is_beside = (right < wall_left) | (left > wall_right) | (bottom < wall_top) | (top > wall_bottom)
        refused = refused | ~is_beside
    return refused


def is_near(x: Tensor, y: Tensor, goal: int) -> Tensor:
    """Return which positions are within reach of the coffee, the mail or the target, bool `[*B]`."""
    at_x, at_y = PLACES[goal]
    return ((x - at_x).abs() <= REACH) & ((y - at_y).abs() <= REACH)


def open_goals(state: OfficeState) -> Tensor:
    """Return which of `GOALS` are open, bool `[N, 3]`: what the agent lacks; the target once it has both."""
    has_coffee, has_mail = state.coffee != 0, state.mail != 0
    return torch.stack([~has_coffee, ~has_mail, has_coffee & has_mail], -1)


def goal_in_mind(is_open: Tensor, option: Tensor) -> Tensor:
    """Return the goals that agents go for, `[N]`: the chosen ones, or the first open one if the chosen one is not.

    Args:
        is_open: which goals are open, bool `[N, 3]`.
        option: the chosen goals, `[N]`.
    """
    is_possible = is_open.gather(-1, option.unsqueeze(-1)).squeeze(-1)
    return torch.where(is_possible, option, is_open.int().argmax(-1))
