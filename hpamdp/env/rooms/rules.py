"""The rules of Rooms as pure functions, and the best returns by dynamic programming.

A problem of this project, after the four rooms of Sutton, Precup and Singh 1999, *Between MDPs and semi-MDPs*, section
2. A doorway connects each two neighbouring rooms. Two things are new here. The floor of a room is ice or sand, so the
best option changes from room to room. And a move has a length.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.counter_rng import RngKey

OUTCOMES = ("going on", "arrived", "time limit")
GOING_ON, ARRIVED, TIME_LIMIT = range(3)
SKATES, BOOTS = range(2)

SIZE = 11  # cells from wall to wall
WALL = 5  # the row and the column of the inner walls
DOORS = (2, 8)  # places of the doorways along the inner walls
GOAL = SIZE - 1  # both coordinates
REACH = 3  # cells of a full move if the option suits the floor; otherwise 1
STEP_COST = 0.02
DIRECTIONS = ((0, -1), (1, 0), (0, 1), (-1, 0))  # up, right, down, left; y grows downwards


class RoomsState(NamedTuple):
    """The state of N environments, columns `[N]`, int32: the cell of the agent, and the counters of the episode."""

    x: Tensor
    y: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


def is_free(x: Tensor, y: Tensor) -> Tensor:
    """Return which cells lie inside and are no wall."""
    is_inside = (x >= 0) & (x < SIZE) & (y >= 0) & (y < SIZE)
    is_wall = ((x == WALL) & (y != DOORS[0]) & (y != DOORS[1])) | ((y == WALL) & (x != DOORS[0]) & (x != DOORS[1]))
    return is_inside & ~is_wall


def suits(option: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return whether the option suits the floor: skates on ice, boots on sand, neither in a doorway."""
    is_sand = (x > WALL) ^ (y > WALL)
    is_doorway = (x == WALL) | (y == WALL)
    return (option == is_sand) & ~is_doorway


def move(x: Tensor, y: Tensor, option: Tensor, direction: Tensor, fraction: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cells in which moves end. A move stops at walls and at the goal.

    Args:
        x, y: cells in which the moves begin.
        option: current options.
        direction: indices into `DIRECTIONS`.
        fraction: length of the move as a fraction of the reach, in [0, 1]. The length is rounded to whole cells.
    """
    reach = torch.where(suits(option, x, y), float(REACH), 1.0)
    length = (fraction * reach).round()
    step = torch.tensor(DIRECTIONS, dtype=x.dtype, device=x.device)[direction]
    is_moving = torch.ones_like(x, dtype=torch.bool)
    for i in range(REACH):
        next_x, next_y = x + step[..., 0], y + step[..., 1]
        at_goal = (x == GOAL) & (y == GOAL)
        is_moving = is_moving & (i < length) & is_free(next_x, next_y) & ~at_goal
        x = torch.where(is_moving, next_x, x)
        y = torch.where(is_moving, next_y, y)
    return x, y


def start(episode: Tensor, rng: RngKey) -> RoomsState:
    """Return the initial states of the episodes with these numbers, int32 `[N]`, anywhere in the first room."""
    x, y = ((counter_rng.uniform(rng, i) * WALL).floor().clamp(max=WALL - 1).int() for i in range(2))
    none = torch.zeros_like(episode)
    return RoomsState(x, y, none, none, episode)


def act(state: RoomsState, option: Tensor, direction: Tensor, fraction: Tensor) -> tuple[RoomsState, Tensor]:
    """Return the states after one move in every environment, and the rewards, `[N]`."""
    x, y = move(state.x, state.y, option, direction, fraction)
    is_there = (x == GOAL) & (y == GOAL)
    reward = is_there.float() - STEP_COST
    outcome = torch.where(is_there, ARRIVED, GOING_ON).int()
    return state._replace(x=x, y=y, steps=state.steps + 1, outcome=outcome), reward


def observe(state: RoomsState) -> Tensor:
    """Return the observation `[N, 2 + 2 SIZE]`: both coordinates scaled to [-1, 1], then each as a one-hot vector."""
    place = torch.stack([state.x, state.y], -1)
    one_hot = (place.unsqueeze(-1) == torch.arange(SIZE, device=place.device)).flatten(-2)
    return torch.cat([2.0 * place.float() / (SIZE - 1) - 1.0, one_hot.float()], -1)


def best_values(gamma: float, option_length: int) -> Tensor:
    """Return the optimal discounted return from every cell when an option is due, float64 `[x, y]`.

    It is computed by value iteration, without a time limit. Walls and the goal have the value 0.

    Args:
        gamma: discount per step.
        option_length: number of steps after which an option ends. If 1, options can change at every step.
    """
    cells = torch.arange(SIZE)
    x, y = (part.flatten() for part in torch.meshgrid(cells, cells, indexing="ij"))
    number = len(x)
    option, direction, length = torch.meshgrid(
        torch.arange(2), torch.arange(len(DIRECTIONS)), torch.arange(1, REACH + 1), indexing="ij"
    )
    shape = (number, *option.shape)
    from_x, from_y = (part.reshape(-1, 1, 1, 1).expand(shape) for part in (x, y))
    # If the option does not suit the floor, every fraction above a half gives a full move.
    to_x, to_y = move(from_x, from_y, option.expand(shape), direction.expand(shape), length.expand(shape) / REACH)
    successor = (to_x * SIZE + to_y).flatten(2)
    is_there = ((to_x == GOAL) & (to_y == GOAL)).flatten(2)
    is_nothing = ((x == GOAL) & (y == GOAL)) | ~is_free(x, y)
    value = torch.zeros(number, dtype=torch.float64)
    while True:
        after = value.expand(2, number)  # the value once the option has ended
        for _ in range(option_length):
            following = torch.stack([after[o][successor[:, o]] for o in range(2)], 1)
            backup = torch.where(is_there, 1.0, gamma * following) - STEP_COST
            after = backup.amax(-1).T.masked_fill(is_nothing, 0.0)
        best = after.amax(0)
        if torch.allclose(best, value, rtol=0.0, atol=1e-9):
            return best.reshape(SIZE, SIZE)
        value = best
