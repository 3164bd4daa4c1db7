"""The rules of the Platform domain for one row, and the loop over all rows that Numba compiles.

Source: Masson, Ranchod & Konidaris 2016, arXiv:1509.01644, section on the Platform domain. Constants, bounds and rules
as in gym-platform, the version of Bester, James & Konidaris 2019, arXiv:1905.04388.
Differs from the source:
- Observations are scaled to [-1, 1], as those authors do for their learners.
- Observations leave out the number of ticks of the last action.
- The height and the length of a jump have closed forms, which are equal up to rounding.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from hpamdp.env import kernels
from hpamdp.env.kernels import EPISODE_ROW, ONE, OUTCOME_ROW, STEPS_ROW, TWO, ZERO, inlined, kernel, part

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
FIRST_START, SECOND_START = RIGHT[0] - BODY_WIDTH, RIGHT[1] - BODY_WIDTH  # where the enemies start and turn

_F = np.float32
_LEFTS, _RIGHTS = np.array(LEFT, np.float32), np.array(RIGHT, np.float32)
_END, _WIDTH, _HEIGHT, _LENGTH = _F(END), _F(BODY_WIDTH), _F(BODY_HEIGHT), _F(END + BODY_WIDTH)
_SECOND_EDGE, _THIRD_EDGE = _F(LEFT[1] - BODY_WIDTH), _F(LEFT[2] - BODY_WIDTH)
_FIRST_START, _SECOND_START = _F(FIRST_START), _F(SECOND_START)
_TICK = _F(0.05)
_GRAVITY = _F(9.8)
_FALL = _F(0.5 * 9.8 * 0.05)  # of the vertical speed in half a tick
_MAX_SPEED = _F(70.0)  # px/s
_MAX_PUSH = _F(30.0)  # px/s, largest change of the speed by an action in one tick
_DECAY = _F(0.99)  # factor on the speed after each tick
_RUN_TICKS = 20
_HOP_RISE, _LEAP_RISE = _F(35.0), _F(25.0)  # vertical speed at the start of a jump, px/s
_ENEMY = _F(30.0)  # largest speed of an enemy
_JUMP_NOISE = _F(1.0)  # standard deviation of the speeds at the start of a jump, px/s
_TICK_NOISE = _F(0.5 * 0.05)  # standard deviation of the change of speed in a tick, px/s
_HUNDRED = _F(100.0)
# Normal random numbers that each action of an episode may use: two for a jump, then two per tick. A hop has 144 ticks.
_NUMBERS_PER_ACTION = 512
# Observed features of each platform: its width, the next platform's width, the gap and its left edge, all in [0, 1],
# and the next platform's height.
_FEATURES = np.array(
    (
        (250 / 275, 275 / 275, 225 / 235, LEFT[0] / END, 0.0),
        (275 / 275, 50 / 275, 235 / 235, LEFT[1] / END, 0.0),
        (50 / 275, 0.0, 0.0, LEFT[2] / END, 0.0),
    ),
    np.float32,
)

NOISE = kernels.OWN  # the problem's own setting
_X, _SPEED, _ENEMY_X, _ENEMY_SPEED = range(4)  # rows of the floats


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


@part
def _patrol(before: Any, after: Any, x: Any, speed: Any, gust: Any) -> Any:
    """Return position and speed of the enemy after a tick. It turns at the edges of its platform.

    Args:
        before, after: the agent's positions before and after the tick.
        x, speed: of the enemy.
        gust: px/s added to its speed.
    """
    is_second = before > _LEFTS[1]
    low = _LEFTS[1] if is_second else _LEFTS[0]
    high = _SECOND_START if is_second else _FIRST_START
    fastest = _ENEMY
    if after > _LEFTS[1] and not is_second:
        # When the agent reaches the second platform, that platform's enemy takes over from its start.
        low, high, fastest = _SECOND_START, _SECOND_START, -_ENEMY
    if not ((low < x) & (x < high)):
        speed = -speed
    speed = min(max(speed + gust, -_ENEMY), fastest)
    return min(max(x + _TICK * speed, low), high), speed


@part
def _land(x: Any, depth: Any) -> Any:
    """Return where an agent ends up that has come down, and whether it stands on a platform.

    A platform pushes an overlapping agent out by the shorter way: up, or over the platform's edge.

    Args:
        x: position of the agent.
        depth: px by which it is below the top of the platforms.
    """
    landed, stands = x, False
    for platform in range(3):
        from_left, from_right = x - (_LEFTS[platform] - _WIDTH), _RIGHTS[platform] - x
        inside = min(from_left, from_right)
        stands |= inside >= depth
        if ZERO < inside < depth:
            landed = _LEFTS[platform] - _WIDTH if from_left < from_right else _RIGHTS[platform]
    return landed, stands


@inlined
def _edge(x: Any) -> Any:
    """Return the right edge of the platform that an agent is on."""
    return _RIGHTS[0] if x < _SECOND_EDGE else (_RIGHTS[1] if x < _THIRD_EDGE else _RIGHTS[2])


@part
def _act(floats: Any, row: Any, action: Any, given: Any, first: Any, bits: Any, step: Any, noise: Any) -> Any:
    """Take an action in a row and return its outcome.

    Args:
        floats, row: the state and the place in it.
        action: RUN, HOP or LEAP.
        given: its parameter.
        first: index of the first random number of the action.
        bits, step: of the row's random numbers.
        noise: factor on the published noise.
    """
    x, speed = floats[_X, row], floats[_SPEED, row]
    enemy_x, enemy_speed = floats[_ENEMY_X, row], floats[_ENEMY_SPEED, row]
    edge = _edge(x)
    is_jump = (action != RUN) & (x <= edge)  # an agent beyond the edge falls, whatever the action
    power, rise = given, ZERO
    length = _RUN_TICKS
    if is_jump:
        power = ZERO
        rise = _HOP_RISE if action == HOP else _LEAP_RISE
        push = given / (TWO * rise / _GRAVITY + ONE) - speed
        push -= noise * _JUMP_NOISE * abs(kernels.normal(bits, step, first))
        rise -= noise * _JUMP_NOISE * abs(kernels.normal(bits, step, first + 1))
        speed += min(max(push, -_MAX_PUSH), _MAX_PUSH)
        length = int(max(math.floor(rise / _FALL), -1) + 2)
    height, has_met, is_off = ZERO, False, False
    for tick in range(max(length, 1)):
        drag = noise * _TICK_NOISE * abs(kernels.normal(bits, step, first + 2 + 2 * tick))
        gust = noise * _TICK_NOISE * kernels.normal(bits, step, first + 3 + 2 * tick)
        before = x
        speed = min(max(speed + (power if x <= edge else ZERO) - drag, ZERO), _MAX_SPEED)
        x = min(x + _TICK * speed, _END)
        speed *= _DECAY
        enemy_x, enemy_speed = _patrol(before, x, enemy_x, enemy_speed, gust)
        if is_jump:  # tick k, counted from 0, ends at the height (k + 1) (rise - k fall) _TICK
            height = _F(tick + 1) * (rise - _F(tick) * _FALL) * _TICK
        has_met = (abs(x - enemy_x) < _WIDTH) & (height < _HEIGHT)
        is_off = (not is_jump) & (before > edge)
        if has_met or is_off or x >= _END:
            break
    outcome = FELL if is_off else ON_THE_WAY
    if height < ZERO:
        landed, stands = _land(x, -height)
        if stands or landed != x:
            speed = ZERO
        x = landed
        if not stands:
            outcome = FELL
    if has_met:
        outcome = MET_ENEMY
    if x >= _END:
        outcome = ARRIVED
    floats[_X, row], floats[_SPEED, row] = x, speed
    floats[_ENEMY_X, row], floats[_ENEMY_SPEED, row] = enemy_x, enemy_speed
    return outcome


@part
def _start(floats: Any, row: Any) -> None:
    """Put agent and enemy where an episode begins."""
    floats[_X, row], floats[_SPEED, row] = ZERO, ZERO
    floats[_ENEMY_X, row], floats[_ENEMY_SPEED, row] = _FIRST_START, -_ENEMY


@part
def _observe(floats: Any, row: Any, observation: Any) -> None:
    """Write what is observed of a row, scaled to [-1, 1]."""
    x = floats[_X, row]
    observation[0] = (x + _WIDTH) / _LENGTH
    observation[1] = floats[_SPEED, row] / _HUNDRED
    observation[2] = floats[_ENEMY_X, row] / _END
    observation[3] = (floats[_ENEMY_SPEED, row] + _ENEMY) / (TWO * _ENEMY)
    platform = int(x >= _LEFTS[1]) + int(x >= _LEFTS[2])
    for i in range(5):
        observation[4 + i] = _FEATURES[platform, i]
    for i in range(9):
        observation[i] = TWO * observation[i] - ONE


@kernel
def advance(
    state: Any, option: Any, discrete: Any, parameters: Any, mask: Any, settings: Any, mode: Any, results: Any
) -> int:
    """Act or restart in every row, in place; see `hpamdp.env.kernel_rows`."""
    floats, integers = state
    observations, outcomes, _, flags, rewards = results
    invalid = kernels.invalid_row(option, discrete, parameters, integers, settings, mode)
    if invalid >= 0:
        return invalid
    noise = _F(settings[NOISE])
    for row in range(len(mask)):
        was_over = integers[OUTCOME_ROW, row] != ON_THE_WAY
        if mode != kernels.RESTART and mask[row] and not was_over:
            action, steps, before = discrete[row], integers[STEPS_ROW, row], floats[_X, row]
            given = kernels.parameter(parameters, row, 0, action)
            bits, step = kernels.noise_rng(settings, row, integers[EPISODE_ROW, row])
            outcome = _act(floats, row, action, given, steps * _NUMBERS_PER_ACTION, bits, step, noise)
            kernels.end_step(integers, row, outcome, len(OUTCOMES), settings)
            rewards[row] = (floats[_X, row] - before) / _END
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                kernels.new_episode(integers, row, settings)
                _start(floats, row)
            _observe(floats, row, observations[reading, row])
            kernels.report(integers[OUTCOME_ROW, row], len(OUTCOMES), row, outcomes[reading], flags[reading])
    return -1
