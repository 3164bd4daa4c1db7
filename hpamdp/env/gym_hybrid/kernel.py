"""The rules of Moving and Sliding as loops over rows that Numba compiles.

A test compares it with the tensor functions in experiments/domains/published_rules. Blocks of rows are copied into
lanes, one row each; loops over the lanes have no branches and become vector instructions. Every lane does the same, so
that no row depends on its lane.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import int32

from hpamdp.env import kernels
from hpamdp.env.gym_hybrid import rules
from hpamdp.env.kernels import (
    ONE,
    OUTCOME_ROW,
    STEPS_ROW,
    TURN,
    TWO,
    ZERO,
    atan2,
    inlined,
    kernel,
    part,
    sin_cos,
    unsigned,
)

SLIDES = kernels.OWN  # the problem's own setting

# Rows of the state, and the first columns of the lanes.
_X, _Y, _SPEED, _HEADING, _COURSE, _TARGET_X, _TARGET_Y = range(7)
_NUM_COLUMNS = _TARGET_Y + 1

_LANES = 64  # with fewer, beginning and ending the loops takes longer; with 128 a single row does
# Further columns of the lanes' float32: the parameter of the action, and its reward.
_GIVEN, _REWARD = range(_NUM_COLUMNS, _NUM_COLUMNS + 2)
_NUM_FLOATS = _REWARD + 1
# Columns of the lanes' int32.
_ACTION, _MOVES, _STEPS, _OUTCOME, _WAS_OVER = range(5)
_NUM_INTEGERS = _WAS_OVER + 1
_OBSERVATION_DIM = len(rules.OBSERVATION_NAMES)

_F = np.float32
_PUSH, _STEP, _BRAKE, _RIGHT_ANGLE = _F(rules.LARGEST_PUSH), _F(rules.STEP), _F(rules._BRAKE), _F(rules._TURN)
_RADIUS, _TARGET_BOUND, _STEP_COST = _F(rules.TARGET_RADIUS), _F(rules._TARGET_BOUND), _F(rules._STEP_COST)
_SUCCESS_REWARD, _FAILURE_REWARD = _F(rules._SUCCESS_REWARD), _F(rules._FAILURE_REWARD)
_TURNS = _F(0.5 / math.pi)
_MOST_STEPS = 2.0**31 - 1.0  # that an int32 counts


@inlined
def _length(x: Any, y: Any) -> Any:
    return math.sqrt(x * x + y * y)


@inlined
def _steer(speed: Any, heading: Any, course: Any, action: Any, given: Any, slides: Any) -> Any:
    """Return speed, heading and course after an action."""
    is_turn, is_brake = action == rules.TURN, action == rules.BRAKE
    turned = heading + _RIGHT_ANGLE * given
    turned -= TURN * _F(np.floor(_TURNS * turned))
    turned = turned + TURN if turned < ZERO else turned  # rounding can make it negative
    slowed = ZERO if speed < _BRAKE else speed - _BRAKE
    push = _PUSH * given
    if not slides:
        pushed = speed + push
        heading_after = turned if is_turn else heading
        course_after = heading_after
    else:
        sin, cos = sin_cos(course - heading)
        squared = push * push + speed * speed + TWO * push * speed * cos
        pushed = math.sqrt(max(squared, ZERO))  # rounding can make it negative
        course_pushed = heading + atan2(speed * sin, push + speed * cos)
        course_slowed = heading if slowed == ZERO else course
        heading_after = turned if is_turn else heading
        course_after = course_slowed if is_brake else (course if is_turn else course_pushed)
    return slowed if is_brake else (speed if is_turn else pushed), heading_after, course_after


@part
def _act(lanes: Any, numbers: Any, max_steps: Any, slides: Any) -> None:
    """Take the actions of all lanes that move."""
    for j in range(_LANES):
        moves, action = numbers[_MOVES * _LANES + j] != 0, numbers[_ACTION * _LANES + j]
        x, y, speed = lanes[_X * _LANES + j], lanes[_Y * _LANES + j], lanes[_SPEED * _LANES + j]
        heading, course = lanes[_HEADING * _LANES + j], lanes[_COURSE * _LANES + j]
        target_x, target_y = lanes[_TARGET_X * _LANES + j], lanes[_TARGET_Y * _LANES + j]
        before = _length(target_x - x, target_y - y)
        given = lanes[_GIVEN * _LANES + j]
        speed_after, heading_after, course_after = _steer(speed, heading, course, action, given, slides)
        sin, cos = sin_cos(course_after)
        x_after, y_after = x + _STEP * speed_after * cos, y + _STEP * speed_after * sin
        left = _length(target_x - x_after, target_y - y_after)
        way = before - left - _STEP_COST
        steps = numbers[_STEPS * _LANES + j] + int32(moves)
        has_stopped = (left < _RADIUS) & (speed_after == ZERO)
        has_left = (abs(x_after) > ONE) | (abs(y_after) > ONE)
        is_late = steps >= max_steps
        outcome = int32(rules.TIME_LIMIT) if is_late else int32(rules.GOING_ON)
        outcome = int32(rules.LEFT_FIELD) if has_left else outcome
        outcome = int32(rules.STOPPED) if has_stopped else outcome
        reward = _FAILURE_REWARD if has_left | is_late else way
        reward = way + _SUCCESS_REWARD if has_stopped else reward

        lanes[_X * _LANES + j], lanes[_Y * _LANES + j] = x_after if moves else x, y_after if moves else y
        lanes[_SPEED * _LANES + j] = speed_after if moves else speed
        lanes[_HEADING * _LANES + j] = heading_after if moves else heading
        lanes[_COURSE * _LANES + j] = course_after if moves else course
        lanes[_REWARD * _LANES + j] = reward if moves else ZERO
        numbers[_OUTCOME * _LANES + j] = outcome if moves else numbers[_OUTCOME * _LANES + j]
        numbers[_STEPS * _LANES + j] = steps


@part
def _observe(lanes: Any, numbers: Any, latest: Any, seen: Any) -> None:
    """Write what is observed of all lanes, columns as those of the lanes."""
    for j in range(_LANES):
        x, y = lanes[_X * _LANES + j], lanes[_Y * _LANES + j]
        target_x, target_y = lanes[_TARGET_X * _LANES + j], lanes[_TARGET_Y * _LANES + j]
        left = _length(target_x - x, target_y - y)
        sin, cos = sin_cos(lanes[_HEADING * _LANES + j])
        seen[j], seen[_LANES + j], seen[2 * _LANES + j] = x, y, lanes[_SPEED * _LANES + j]
        seen[3 * _LANES + j], seen[4 * _LANES + j] = cos, sin
        seen[5 * _LANES + j], seen[6 * _LANES + j] = target_x, target_y
        seen[7 * _LANES + j], seen[8 * _LANES + j] = left, ONE if left <= _RADIUS else ZERO
        seen[9 * _LANES + j] = _F(numbers[_STEPS * _LANES + j]) / latest


@part
def _start(lanes: Any, numbers: Any, j: Any, bits: Any, step: Any) -> None:
    """Put vehicle and target of a lane anywhere in the field."""
    lanes[_TARGET_X * _LANES + j] = _TARGET_BOUND * (TWO * kernels.uniform(bits, step, 0) - ONE)
    lanes[_TARGET_Y * _LANES + j] = _TARGET_BOUND * (TWO * kernels.uniform(bits, step, 1) - ONE)
    lanes[_X * _LANES + j] = TWO * kernels.uniform(bits, step, 2) - ONE
    lanes[_Y * _LANES + j] = TWO * kernels.uniform(bits, step, 3) - ONE
    heading = TURN * kernels.uniform(bits, step, 4)
    lanes[_HEADING * _LANES + j], lanes[_COURSE * _LANES + j] = heading, heading
    lanes[_SPEED * _LANES + j] = ZERO
    numbers[_STEPS * _LANES + j], numbers[_OUTCOME * _LANES + j] = 0, rules.GOING_ON


@part
def _load(
    lanes: Any,
    numbers: Any,
    first: Any,
    width: Any,
    floats: Any,
    integers: Any,
    discrete: Any,
    parameters: Any,
    mask: Any,
    mode: Any,
) -> None:
    """Copy rows into the lanes, with their actions; the other lanes stay as they are."""
    for column in range(_NUM_COLUMNS):
        for j in range(width):
            lanes[column * _LANES + j] = floats[column, unsigned(first + j)]
    for j in range(width):
        numbers[_STEPS * _LANES + j] = integers[STEPS_ROW, unsigned(first + j)]
    for j in range(width):
        numbers[_OUTCOME * _LANES + j] = integers[OUTCOME_ROW, unsigned(first + j)]
    for j in range(width):
        was_over = numbers[_OUTCOME * _LANES + j] != rules.GOING_ON
        numbers[_WAS_OVER * _LANES + j] = was_over
        numbers[_MOVES * _LANES + j] = (mode != kernels.RESTART) & mask[unsigned(first + j)] & (not was_over)
    given, _, bounds = parameters
    least_push, least_turn, most_push, most_turn = bounds[0, 0], bounds[0, 1], bounds[1, 0], bounds[1, 1]
    for j in range(width):
        row = unsigned(first + j)
        action = int32(discrete[row])
        push = min(max(given[row, 0], least_push), most_push)
        turn = min(max(given[row, 1], least_turn), most_turn)
        numbers[_ACTION * _LANES + j] = action
        lanes[_GIVEN * _LANES + j] = turn if action == rules.TURN else push


@part
def _store(lanes: Any, numbers: Any, first: Any, width: Any, floats: Any, integers: Any) -> None:
    """Copy the lanes back into their rows."""
    for column in range(_NUM_COLUMNS):
        for j in range(width):
            floats[column, unsigned(first + j)] = lanes[column * _LANES + j]
    for j in range(width):
        integers[STEPS_ROW, unsigned(first + j)] = numbers[_STEPS * _LANES + j]
    for j in range(width):
        integers[OUTCOME_ROW, unsigned(first + j)] = numbers[_OUTCOME * _LANES + j]


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
    max_steps, slides = int32(min(settings[kernels.MAX_STEPS], _MOST_STEPS)), settings[SLIDES] != 0.0
    latest = _F(max(settings[kernels.MAX_STEPS] - 1.0, 1.0))
    lanes, numbers = np.zeros(_NUM_FLOATS * _LANES, np.float32), np.zeros(_NUM_INTEGERS * _LANES, np.int32)
    seen = np.empty(_OBSERVATION_DIM * _LANES, np.float32)
    numbers_seen = observations.reshape(len(observations), -1)
    for first in range(0, len(mask), _LANES):
        width = min(_LANES, len(mask) - first)
        _load(lanes, numbers, first, width, floats, integers, discrete, parameters, mask, mode)
        # Two versions: where sliding is a variable, its arc tangent is computed for Moving, too.
        if slides:
            _act(lanes, numbers, max_steps, True)
        else:
            _act(lanes, numbers, max_steps, False)
        for j in range(width):
            rewards[unsigned(first + j)] = lanes[_REWARD * _LANES + j]
        for reading in range(len(observations)):
            must_observe = reading == 0
            for j in range(width):
                was_over, outcome = numbers[_WAS_OVER * _LANES + j] != 0, numbers[_OUTCOME * _LANES + j]
                if kernels.must_restart(mode, reading, was_over, outcome, mask[unsigned(first + j)]):
                    bits, step = kernels.new_episode(integers, first + j, settings)
                    _start(lanes, numbers, j, bits, step)
                    must_observe = True
            if must_observe:
                _observe(lanes, numbers, latest, seen)
                for j in range(width):
                    for entry in range(_OBSERVATION_DIM):
                        observations[reading, unsigned(first + j), entry] = seen[entry * _LANES + j]
            else:  # nothing has changed
                begin = first * _OBSERVATION_DIM
                for place in range(width * _OBSERVATION_DIM):
                    numbers_seen[reading, unsigned(begin + place)] = numbers_seen[reading - 1, unsigned(begin + place)]
            for j in range(width):
                outcome = numbers[_OUTCOME * _LANES + j]
                kernels.report(outcome, len(rules.OUTCOMES), unsigned(first + j), outcomes[reading], flags[reading])
        _store(lanes, numbers, first, width, floats, integers)
    return -1
