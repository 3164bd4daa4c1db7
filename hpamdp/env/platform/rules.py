"""The rules of the Platform domain as pure functions on columns: the course, its agents and its enemies.

Source: Masson, Ranchod & Konidaris 2016, arXiv:1509.01644, section on the Platform domain. Constants, bounds and rules
as in gym-platform, the version of Bester, James & Konidaris 2019, arXiv:1905.04388.
Differs from the source:
- Observations are scaled to [-1, 1], as those authors do for their learners.
- Observations leave out the number of ticks of the last action.
- The height and the length of a jump have closed forms, which are equal up to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

RUN, HOP, LEAP = range(3)
ACTIONS = ("run", "hop", "leap")
PARAMETER_HIGH = (30.0, 720.0, 430.0)
# The parameters that learners conventionally start with (Masson et al. 2016, and the code of Bester et al. 2019).
INITIAL_PARAMETERS = (3.0, 10.0, 400.0)
OUTCOMES = ("on the way", "arrived", "fell", "met an enemy", "time limit")
ON_THE_WAY, ARRIVED, FELL, MET_ENEMY, TIME_LIMIT = range(5)
OBSERVATION_NAMES = (
    "x",
    "speed",
    "enemy_x",
    "enemy_speed",
    "platform_width",
    "next_width",
    "gap",
    "platform_left",
    "next_height",
)

# Lengths in px, times in s. All three platforms have the same height. The position of an agent or an enemy is its left
# edge.
LEFT, RIGHT = (0.0, 475.0, 985.0), (250.0, 750.0, 1035.0)
END = RIGHT[2]
BODY_WIDTH, BODY_HEIGHT = 20.0, 30.0
_TICK = 0.05
_GRAVITY = 9.8
_MAX_SPEED = 70.0  # px/s
_MAX_PUSH = 30.0  # px/s, largest change of the speed by an action in one tick
_DECAY = 0.99  # factor on the speed after each tick
_RUN_TICKS = 20.0
_HOP_RISE, _LEAP_RISE = 35.0, 25.0  # vertical speed at the start of a jump, px/s
_ENEMY_SPEED = 30.0
_FIRST_START, _SECOND_START = RIGHT[0] - BODY_WIDTH, RIGHT[1] - BODY_WIDTH  # where the enemies start and turn
_JUMP_NOISE = 1.0  # standard deviation of the speeds at the start of a jump, px/s
_TICK_NOISE = 0.5 * _TICK  # standard deviation of the change of speed in a tick, px/s
# Normal random numbers that each action of an episode may use: two for a jump, then two per tick. A hop has 144 ticks.
_NUMBERS_PER_ACTION = 512
# Observed features of each platform: its width, the next platform's width, the gap and its left edge, all in [0, 1],
# and the next platform's height.
_PLATFORM_FEATURES = (
    (250 / 275, 275 / 275, 225 / 235, LEFT[0] / END, 0.0),
    (275 / 275, 50 / 275, 235 / 235, LEFT[1] / END, 0.0),
    (50 / 275, 0.0, 0.0, LEFT[2] / END, 0.0),
)


class PlatformState(NamedTuple):
    """The state of N environments, columns `[N]`, px and px/s.

    It holds only the enemy of the platform that the agent reached last. The agent cannot meet the other enemy.
    """

    x: Tensor
    speed: Tensor
    enemy_x: Tensor
    enemy_speed: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor


def start(episode: Tensor) -> PlatformState:
    """Return the initial states of the episodes with these numbers, int32 `[N]`."""
    zeros = torch.zeros_like(episode, dtype=torch.float32)
    integer_zeros = torch.zeros_like(episode)
    return PlatformState(
        x=zeros,
        speed=zeros,
        enemy_x=zeros + _FIRST_START,
        enemy_speed=zeros - _ENEMY_SPEED,
        steps=integer_zeros,
        outcome=integer_zeros + ON_THE_WAY,
        episode=episode,
    )


def act(
    state: PlatformState, discrete: Tensor, parameter: Tensor, normal: Callable[[Tensor], Tensor], noise: float
) -> PlatformState:
    """Return the states after one action in every environment.

    The action is simulated at full length, `[T, N]`, and then cut off at the first event that ends it.

    Args:
        state: states before the action.
        discrete: RUN, HOP or LEAP, `[N]`.
        parameter: parameter of the chosen action, within its bounds, `[N]`.
        normal: maps indices, int32 `[N]` or `[T, N]`, to standard normal numbers of the episodes.
        noise: factor on the published noise.
    """
    edge = torch.where(state.x < LEFT[2] - BODY_WIDTH, RIGHT[1], RIGHT[2])
    edge = torch.where(state.x < LEFT[1] - BODY_WIDTH, RIGHT[0], edge)
    is_jump = (discrete != RUN) & (state.x <= edge)  # an agent beyond the edge falls, whatever the action
    first = first_number(state)
    rise = torch.where(discrete == HOP, _HOP_RISE, _LEAP_RISE).to(state.x.dtype)
    push = parameter / (2.0 * rise / _GRAVITY + 1.0) - state.speed
    push = push - noise * _JUMP_NOISE * normal(first).abs()
    rise = rise - noise * _JUMP_NOISE * normal(first + 1).abs()
    speed = state.speed + torch.where(is_jump, push.clamp(-_MAX_PUSH, _MAX_PUSH), 0.0)
    # Tick k of a jump, counted from 0, ends at the height (k + 1) (rise - k fall) _TICK.
    fall = 0.5 * _GRAVITY * _TICK
    length = torch.where(is_jump, (rise / fall).floor().clamp(min=-1.0) + 2.0, _RUN_TICKS)
    tick = torch.arange(int(length.max()), dtype=torch.int32, device=state.x.device).unsqueeze(-1)
    index = first + 2 + 2 * tick
    drag = noise * _TICK_NOISE * normal(index).abs()
    gust = noise * _TICK_NOISE * normal(index + 1)

    before, x, speed = _move(state.x, speed, edge, torch.where(is_jump, 0.0, parameter), drag)
    enemy_x, enemy_speed = _patrol(before, x, state.enemy_x, state.enemy_speed, gust)
    height = torch.where(is_jump, (tick + 1) * (rise - tick * fall) * _TICK, 0.0)
    has_met = ((x - enemy_x).abs() < BODY_WIDTH) & (height < BODY_HEIGHT)
    is_off = ~is_jump & (before > edge)
    is_end = has_met | is_off | (x >= END) | (tick == length - 1.0)
    end = torch.where(is_end, tick, len(tick)).amin(0, keepdim=True).long()
    x, speed, enemy_x, enemy_speed, height, has_met, is_off = (
        trace.gather(0, end).squeeze(0) for trace in (x, speed, enemy_x, enemy_speed, height, has_met, is_off)
    )

    is_down = height < 0.0
    landed_x, stands = _land(x, -height)
    is_stopped = is_down & (stands | (landed_x != x))
    x = torch.where(is_down, landed_x, x)
    outcome = torch.where(is_off | (is_down & ~stands), FELL, ON_THE_WAY)
    outcome = torch.where(has_met, MET_ENEMY, outcome)
    outcome = torch.where(x >= END, ARRIVED, outcome).to(torch.int32)
    speed = torch.where(is_stopped, 0.0, speed)
    return PlatformState(x, speed, enemy_x, enemy_speed, state.steps + 1, outcome, state.episode)


def first_number(state: PlatformState) -> Tensor:
    """Return the index `[N]` of the first random number of the next action."""
    return state.steps * _NUMBERS_PER_ACTION


def _move(x: Tensor, speed: Tensor, edge: Tensor, power: Tensor, drag: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the agents' positions before and after each tick, and their speeds after it, `[T, N]` each.

    Args:
        x, speed: positions and speeds of the agents, `[N]`.
        edge: right edges of their platforms, `[N]`. Beyond the edge, `power` has no effect.
        power: px/s that a run adds to the speed in each tick, `[N]`.
        drag: px/s subtracted from the speed in each tick, `[T, N]`.
    """
    xs = [x]
    speeds = []
    no_power = torch.zeros_like(power)
    for loss in drag.unbind():
        speed = (speed + torch.where(x <= edge, power, no_power) - loss).clamp(0.0, _MAX_SPEED)
        x = torch.add(x, speed, alpha=_TICK)
        speed = speed * _DECAY
        xs.append(x)
        speeds.append(speed)
    trace = torch.stack(xs).clamp(max=END)
    return trace[:-1], trace[1:], torch.stack(speeds)


def _patrol(before: Tensor, after: Tensor, x: Tensor, speed: Tensor, gust: Tensor) -> tuple[Tensor, Tensor]:
    """Return the enemies' positions and speeds after each tick, `[T, N]` each.

    An enemy turns at the edges of its platform.

    Args:
        before, after: the agents' positions before and after each tick, `[T, N]`.
        x, speed: positions and speeds of the enemies, `[N]`.
        gust: px/s added to the enemies' speeds in each tick, `[T, N]`.
    """
    is_second = before > LEFT[1]
    left = torch.where(is_second, LEFT[1], LEFT[0]).to(gust.dtype)
    right = torch.where(is_second, _SECOND_START, _FIRST_START).to(gust.dtype)
    slowest = torch.full_like(gust, -_ENEMY_SPEED)
    fastest = torch.full_like(gust, _ENEMY_SPEED)
    # When the agent reaches the second platform, that platform's enemy replaces the first one. Equal bounds put the
    # enemy at its start.
    is_reached = (after > LEFT[1]) & ~is_second
    left = left.masked_fill(is_reached, _SECOND_START)
    right = right.masked_fill(is_reached, _SECOND_START)
    fastest = fastest.masked_fill(is_reached, -_ENEMY_SPEED)
    ticks = zip(left.unbind(), right.unbind(), slowest.unbind(), fastest.unbind(), gust.unbind(), strict=True)
    xs = []
    speeds = []
    for low, high, slow, fast, change in ticks:
        speed = torch.where((low < x) & (x < high), speed, -speed)
        speed = (speed + change).clamp(slow, fast)
        x = torch.add(x, speed, alpha=_TICK).clamp(low, high)
        xs.append(x)
        speeds.append(speed)
    return torch.stack(xs), torch.stack(speeds)


def _land(x: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Return the positions of agents after a platform has pushed them out, and whether they stand on it, `[N]` each.

    A platform pushes an overlapping agent out by the shorter way: up, or over the platform's edge.

    Args:
        x: positions of the agents, `[N]`.
        depth: px by which the agents are below the top of the platforms, `[N]`.
    """
    landed = x
    stands = torch.zeros_like(x, dtype=torch.bool)
    for left, right in zip(LEFT, RIGHT, strict=True):
        from_left = x - (left - BODY_WIDTH)
        from_right = right - x
        inside = torch.minimum(from_left, from_right)
        stands = stands | (inside >= depth)
        aside = torch.where(from_left < from_right, left - BODY_WIDTH, right)
        landed = torch.where((inside > 0.0) & (inside < depth), aside, landed)
    return landed, stands


def observe(state: PlatformState) -> Tensor:
    """Return the observation `[N, 9]` with the entries OBSERVATION_NAMES, scaled to [-1, 1]."""
    basic = [
        (state.x + BODY_WIDTH) / (END + BODY_WIDTH),
        state.speed / 100.0,
        state.enemy_x / END,
        (state.enemy_speed + _ENEMY_SPEED) / (2.0 * _ENEMY_SPEED),
    ]
    platform = (state.x >= LEFT[1]).long() + (state.x >= LEFT[2])
    features = torch.tensor(_PLATFORM_FEATURES, dtype=state.x.dtype, device=state.x.device)[platform]
    return 2.0 * torch.cat([torch.stack(basic, -1), features], -1) - 1.0
