"""The rules of Platform for one row, and the loop over all rows that Numba compiles.

It states what `rules` says of columns, for the CPU alone; a test compares the two. An action's ticks are a loop of its
row, which ends where the action does.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hpamdp.env import kernels
from hpamdp.env.kernels import EPISODE_ROW, ONE, OUTCOME_ROW, STEPS_ROW, TWO, ZERO, inlined, kernel, part
from hpamdp.env.platform import rules

NOISE = kernels.OWN  # the problem's own setting

_X, _SPEED, _ENEMY_X, _ENEMY_SPEED = range(4)

_F = np.float32
_LEFT, _RIGHT = np.array(rules.LEFT, np.float32), np.array(rules.RIGHT, np.float32)
_END, _WIDTH, _HEIGHT = _F(rules.END), _F(rules.BODY_WIDTH), _F(rules.BODY_HEIGHT)
_SECOND_EDGE, _THIRD_EDGE = _F(rules.LEFT[1] - rules.BODY_WIDTH), _F(rules.LEFT[2] - rules.BODY_WIDTH)
_TICK, _DECAY, _GRAVITY = _F(rules._TICK), _F(rules._DECAY), _F(rules._GRAVITY)
_MAX_SPEED, _MAX_PUSH = _F(rules._MAX_SPEED), _F(rules._MAX_PUSH)
_HOP_RISE, _LEAP_RISE = _F(rules._HOP_RISE), _F(rules._LEAP_RISE)
_ENEMY, _FIRST_START, _SECOND_START = _F(rules._ENEMY_SPEED), _F(rules._FIRST_START), _F(rules._SECOND_START)
_JUMP_NOISE, _TICK_NOISE = _F(rules._JUMP_NOISE), _F(rules._TICK_NOISE)
_RUN_TICKS = int(rules._RUN_TICKS)
_FALL = _F(0.5 * rules._GRAVITY * rules._TICK)
_FEATURES = np.array(rules._PLATFORM_FEATURES, np.float32)
_LENGTH, _HUNDRED = _F(rules.END + rules.BODY_WIDTH), _F(100.0)


@part
def _patrol(before: Any, after: Any, x: Any, speed: Any, gust: Any) -> Any:
    """Return position and speed of the enemy after a tick: `rules._patrol`."""
    is_second = before > _LEFT[1]
    low = _LEFT[1] if is_second else _LEFT[0]
    high = _SECOND_START if is_second else _FIRST_START
    fastest = _ENEMY
    if after > _LEFT[1] and not is_second:
        # The second enemy takes over from its start.
        low, high, fastest = _SECOND_START, _SECOND_START, -_ENEMY
    if not ((low < x) & (x < high)):
        speed = -speed
    speed = min(max(speed + gust, -_ENEMY), fastest)
    return min(max(x + _TICK * speed, low), high), speed


@part
def _land(x: Any, depth: Any) -> Any:
    """Return where an agent ends up that comes down into a platform, and whether it stands: `rules._land`."""
    landed, stands = x, False
    for platform in range(3):
        from_left, from_right = x - (_LEFT[platform] - _WIDTH), _RIGHT[platform] - x
        inside = min(from_left, from_right)
        stands |= inside >= depth
        if ZERO < inside < depth:
            landed = _LEFT[platform] - _WIDTH if from_left < from_right else _RIGHT[platform]
    return landed, stands


@inlined
def _edge(x: Any) -> Any:
    """Return the right edge of the platform that an agent is on."""
    return _RIGHT[0] if x < _SECOND_EDGE else (_RIGHT[1] if x < _THIRD_EDGE else _RIGHT[2])


@part
def _act(floats: Any, row: Any, action: Any, given: Any, first: Any, bits: Any, step: Any, noise: Any) -> Any:
    """Take an action in a row and return its outcome: `rules.act`."""
    x, speed = floats[_X, row], floats[_SPEED, row]
    enemy_x, enemy_speed = floats[_ENEMY_X, row], floats[_ENEMY_SPEED, row]
    edge = _edge(x)
    is_jump = (action != rules.RUN) & (x <= edge)
    power, rise = given, ZERO
    length = _RUN_TICKS
    if is_jump:
        power = ZERO
        rise = _HOP_RISE if action == rules.HOP else _LEAP_RISE
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
        if is_jump:
            height = _F(tick + 1) * (rise - _F(tick) * _FALL) * _TICK
        has_met = (abs(x - enemy_x) < _WIDTH) & (height < _HEIGHT)
        is_off = (not is_jump) & (before > edge)
        if has_met or is_off or x >= _END:
            break
    outcome = rules.FELL if is_off else rules.ON_THE_WAY
    if height < ZERO:
        landed, stands = _land(x, -height)
        if stands or landed != x:
            speed = ZERO
        x = landed
        if not stands:
            outcome = rules.FELL
    if has_met:
        outcome = rules.MET_ENEMY
    if x >= _END:
        outcome = rules.ARRIVED
    floats[_X, row], floats[_SPEED, row] = x, speed
    floats[_ENEMY_X, row], floats[_ENEMY_SPEED, row] = enemy_x, enemy_speed
    return outcome


@part
def _start(floats: Any, row: Any) -> None:
    """Put agent and enemy where an episode begins: `rules.start`."""
    floats[_X, row], floats[_SPEED, row] = ZERO, ZERO
    floats[_ENEMY_X, row], floats[_ENEMY_SPEED, row] = _FIRST_START, -_ENEMY


@part
def _observe(floats: Any, row: Any, observation: Any) -> None:
    """Write what is observed of a row: `rules.observe`."""
    x = floats[_X, row]
    observation[0] = (x + _WIDTH) / _LENGTH
    observation[1] = floats[_SPEED, row] / _HUNDRED
    observation[2] = floats[_ENEMY_X, row] / _END
    observation[3] = (floats[_ENEMY_SPEED, row] + _ENEMY) / (TWO * _ENEMY)
    platform = int(x >= _LEFT[1]) + int(x >= _LEFT[2])
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
        was_over = integers[OUTCOME_ROW, row] != rules.ON_THE_WAY
        if mode != kernels.RESTART and mask[row] and not was_over:
            action, steps, before = discrete[row], integers[STEPS_ROW, row], floats[_X, row]
            given = kernels.parameter(parameters, row, 0, action)
            bits, step = kernels.noise_rng(settings, row, integers[EPISODE_ROW, row])
            outcome = _act(floats, row, action, given, steps * rules._NUMBERS_PER_ACTION, bits, step, noise)
            kernels.end_step(integers, row, outcome, len(rules.OUTCOMES), settings)
            rewards[row] = (floats[_X, row] - before) / _END
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                kernels.new_episode(integers, row, settings)
                _start(floats, row)
            _observe(floats, row, observations[reading, row])
            kernels.report(integers[OUTCOME_ROW, row], len(rules.OUTCOMES), row, outcomes[reading], flags[reading])
    return -1
