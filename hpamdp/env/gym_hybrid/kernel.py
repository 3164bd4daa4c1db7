"""The rules of Moving and Sliding for one row, and the loop over all rows that Numba compiles.

It states what `rules` says of columns, for the CPU alone; a test compares the two.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hpamdp.env import kernels
from hpamdp.env.gym_hybrid import rules
from hpamdp.env.kernels import ONE, OUTCOME_ROW, STEPS_ROW, TURN, TWO, ZERO, inlined, kernel, part, sin_cos

SLIDES = kernels.OWN  # the problem's own setting

_X, _Y, _SPEED, _HEADING, _COURSE, _TARGET_X, _TARGET_Y = range(7)

_F = np.float32
_PUSH, _STEP, _BRAKE, _RIGHT_ANGLE = _F(rules.LARGEST_PUSH), _F(rules.STEP), _F(rules._BRAKE), _F(rules._TURN)
_RADIUS, _START_BOUND, _STEP_COST = _F(rules.TARGET_RADIUS), _F(rules._START_BOUND), _F(rules._STEP_COST)
_SUCCESS_REWARD, _FAILURE_REWARD = _F(rules._SUCCESS_REWARD), _F(rules._FAILURE_REWARD)


@inlined
def _distance(floats: Any, row: Any) -> Any:
    x, y = floats[_TARGET_X, row] - floats[_X, row], floats[_TARGET_Y, row] - floats[_Y, row]
    return math.sqrt(x * x + y * y)


@part
def _steer(floats: Any, row: Any, action: Any, given: Any, slides: Any) -> None:
    """Change speed, heading and course: `rules._follow` and `rules._slide`."""
    speed, heading, course = floats[_SPEED, row], floats[_HEADING, row], floats[_COURSE, row]
    if action == rules.TURN:
        heading = (heading + _RIGHT_ANGLE * given) % TURN
    elif action == rules.BRAKE:
        speed = ZERO if speed < _BRAKE else speed - _BRAKE
        course = heading if speed == ZERO else course
    elif slides:
        push = _PUSH * given
        sin, cos = sin_cos(course - heading)
        squared = push * push + speed * speed + TWO * push * speed * cos
        course = heading + math.atan2(speed * sin, push + speed * cos)
        speed = math.sqrt(max(squared, ZERO))  # rounding can make it negative
    else:
        speed += _PUSH * given
    floats[_SPEED, row], floats[_HEADING, row] = speed, heading
    floats[_COURSE, row] = course if slides else heading


@part
def _act(floats: Any, row: Any, action: Any, given: Any, is_late: Any, slides: Any) -> Any:
    """Take an action in a row and return its outcome and reward: `rules.act`."""
    before = _distance(floats, row)
    _steer(floats, row, action, given, slides)
    speed = floats[_SPEED, row]
    sin, cos = sin_cos(floats[_COURSE, row])
    x, y = floats[_X, row] + _STEP * speed * cos, floats[_Y, row] + _STEP * speed * sin
    floats[_X, row], floats[_Y, row] = x, y
    left = _distance(floats, row)
    if left < _RADIUS and speed == ZERO:
        return rules.STOPPED, before - left - _STEP_COST + _SUCCESS_REWARD
    if abs(x) > ONE or abs(y) > ONE:
        return rules.LEFT_FIELD, _FAILURE_REWARD
    if is_late:
        return rules.TIME_LIMIT, _FAILURE_REWARD
    return rules.GOING_ON, before - left - _STEP_COST


@part
def _start(floats: Any, row: Any, bits: Any, step: Any) -> None:
    """Put vehicle and target anywhere in the field: `rules.start`."""
    floats[_TARGET_X, row] = _START_BOUND * (TWO * kernels.uniform(bits, step, 0) - ONE)
    floats[_TARGET_Y, row] = _START_BOUND * (TWO * kernels.uniform(bits, step, 1) - ONE)
    floats[_X, row] = TWO * kernels.uniform(bits, step, 2) - ONE
    floats[_Y, row] = TWO * kernels.uniform(bits, step, 3) - ONE
    heading = TURN * kernels.uniform(bits, step, 4)
    floats[_SPEED, row], floats[_HEADING, row], floats[_COURSE, row] = ZERO, heading, heading


@part
def _observe(floats: Any, row: Any, time: Any, observation: Any) -> None:
    """Write what is observed of a row: `rules.observe`."""
    left = _distance(floats, row)
    sin, cos = sin_cos(floats[_HEADING, row])
    observation[0], observation[1], observation[2] = floats[_X, row], floats[_Y, row], floats[_SPEED, row]
    observation[3], observation[4] = cos, sin
    observation[5], observation[6] = floats[_TARGET_X, row], floats[_TARGET_Y, row]
    observation[7], observation[8], observation[9] = left, ONE if left <= _RADIUS else ZERO, time


@kernel
def advance(
    floats: Any,
    integers: Any,
    discrete: Any,
    parameters: Any,
    places: Any,
    bounds: Any,
    mask: Any,
    settings: Any,
    mode: Any,
    observations: Any,
    outcomes: Any,
    flags: Any,
    rewards: Any,
) -> int:
    """Act or restart in every row, in place; see `hpamdp.env.rows`."""
    invalid = kernels.invalid_row(discrete, parameters, places, integers, mode)
    if invalid >= 0:
        return invalid
    max_steps, slides = settings[kernels.MAX_STEPS], settings[SLIDES] != 0.0
    latest = _F(max(max_steps - 1.0, 1.0))
    for row in range(len(mask)):
        was_over = integers[OUTCOME_ROW, row] != rules.GOING_ON
        if mode != kernels.RESTART and mask[row] and not was_over:
            action, steps = discrete[row], integers[STEPS_ROW, row] + 1
            given = kernels.parameter(parameters, row, 0, action, places, bounds)
            outcome, rewards[row] = _act(floats, row, action, given, steps >= max_steps, slides)
            integers[STEPS_ROW, row], integers[OUTCOME_ROW, row] = steps, outcome
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                bits, step = kernels.new_episode(integers, row, settings)
                _start(floats, row, bits, step)
            _observe(floats, row, _F(integers[STEPS_ROW, row]) / latest, observations[reading, row])
            kernels.report(integers[OUTCOME_ROW, row], len(rules.OUTCOMES), row, outcomes[reading], flags[reading])
    return -1
