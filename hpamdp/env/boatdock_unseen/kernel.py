"""The rules of sessions for one row, and the loop over all rows that Numba compiles.

A test compares it with the tensor functions in experiments/generalisation/session_rules.py and `fleet`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import int32

from hpamdp.env import kernels
from hpamdp.env.boatdock import kernel as boats
from hpamdp.env.boatdock import task
from hpamdp.env.boatdock_unseen import fleet, rules
from hpamdp.env.boatdock_unseen.options import FAMILIES
from hpamdp.env.kernels import (
    EPISODE_ROW,
    EPISODE_STREAM,
    FIRST_ENV,
    ONE,
    OUTCOME_ROW,
    OWN,
    SEED,
    STEPS_ROW,
    TURN,
    TWO,
    ZERO,
    episode_hash,
    inlined,
    kernel,
    normal,
    sin_cos,
    stream_hash,
    stream_step,
    uniform,
)
from hpamdp.env.rng_streams import EVALUATION, TRAINING

# Where each column of the state is: its row of the float32 array or of the int32 array.
AT: Any = rules.SessionState._make((*range(16), *range(9), STEPS_ROW, OUTCOME_ROW, EPISODE_ROW))

# Places of the sessions' own settings.
(
    TRIPS,
    IS_SPARSE,
    MOTOR_NOISE,
    SENSOR_NOISE,
    FAMILY,
    SEPARATION,
    SPREAD,
    FLEET_SIZE,
    FLEET_SEED,
    SCORES_NEW,
    HAS_OWN_FRAME,
) = range(OWN, OWN + 11)

_F = np.float32
_ANY, _STRENGTH = FAMILIES.index("any"), FAMILIES.index("strength")
_THIRD = _F(2.0 * math.pi / task.NUM_KEYS)
_KEYS, _ORDERS = int32(task.NUM_KEYS), _F(fleet.NUM_ORDERS)
_UNIT, _SPEED = _F(1.0 / task.HARBOUR_RADIUS), _F(1.0 / task.SPEED_SCALE)
_GLIDE, _TANK, _LONGEST = _F(task.GLIDE), _F(task.TANK), _F(task.MAX_DURATION)
_SUCCESS, _FAILURE = _F(task.SUCCESS_REWARD), _F(task.FAILURE_REWARD)
_NEAREST = _F(task.DOCK_RADIUS / task.HARBOUR_RADIUS)
_SHORTEST_AXIS = _F(rules._SHORTEST_AXIS)

# Places in the observation. It begins as the state does, with the coordinates of start, goal and boat.
_NUM_COORDINATES = AT.y + 1
_TO_GOAL, _VELOCITY, _MOVED = (rules.OBSERVATION_NAMES.index(f"{name}_x") for name in ("to_goal", "velocity", "moved"))
_FUEL, _DISTANCE, _TRIP, _BOAT, _LAST_KEY, _LAST_DURATION, _LAST_SCORE = (
    rules.OBSERVATION_NAMES.index(name)
    for name in ("fuel", "distance", "trip", "boat", "last_key_1", "last_duration", "last_score")
)


@inlined
def _direction(bits: Any, key: Any, settings: Any) -> Any:
    """Return the unit direction of a boat's key, as `fleet.direction` does for columns."""
    step = stream_step(int32(TRAINING))
    order = int32(uniform(bits, step, fleet.ORDER) * _ORDERS)
    shift = order % _KEYS
    slot = int32(((key + shift) if order < _KEYS else (shift - key + _KEYS)) % _KEYS)
    offset = _F(slot) * _THIRD
    if settings[FAMILY] == _ANY:
        first, second = uniform(bits, step, fleet.FIRST_GAP), uniform(bits, step, fleet.SECOND_GAP)
        separation = _F(settings[SEPARATION])
        free = TURN - _F(task.NUM_KEYS) * separation
        one, two = separation + free * min(first, second), TWO * separation + free * max(first, second)
        offset = ZERO if slot == 0 else (one if slot == 1 else two)
    sine, cosine = sin_cos(TURN * uniform(bits, step, fleet.TURN) + offset)
    return cosine, sine


@inlined
def _strength_and_glide(bits: Any, settings: Any) -> Any:
    """Return speed and glide of a boat, as `fleet.strength_and_glide` does for columns."""
    if settings[FAMILY] != _STRENGTH:
        return ONE, ONE
    step, spread = stream_step(int32(TRAINING)), _F(settings[SPREAD])
    strength = ONE + spread * (TWO * uniform(bits, step, fleet.STRENGTH) - ONE)
    return strength, ONE + spread * (TWO * uniform(bits, step, fleet.GLIDE) - ONE)


@inlined
def _session_hash(settings: Any, row: Any, episode: Any, number: Any) -> Any:
    """Return the bits of a random-number key of a session, as `UnseenBoatsEnv` numbers them."""
    base = stream_hash(settings[SEED], int32(settings[EPISODE_STREAM]))
    return episode_hash(base, int32(settings[FIRST_ENV]) + row, episode * int32(rules.NUMBERS_PER_SESSION) + number)


@inlined
def _draw_boats(settings: Any, row: Any, episode: Any) -> Any:
    """Return the bits of a session's two boats, as `UnseenBoatsEnv` draws them."""
    stream = int32(settings[EPISODE_STREAM])
    first = _session_hash(settings, row, episode, int32(rules.FIRST_BOAT))
    second = _session_hash(settings, row, episode, int32(rules.FIRST_BOAT + 1))
    is_test = stream == EVALUATION and settings[SCORES_NEW] != 0.0
    if is_test:
        return int32(first) | int32(1), int32(second) | int32(1)
    size = int32(settings[FLEET_SIZE])
    if size > 0:
        step = stream_step(stream)
        number = min(int32(uniform(first, step, 0) * _F(size)), size - int32(1))
        beside = min(int32(uniform(first, step, 1) * _F(size - int32(1))), max(size - int32(2), int32(0)))
        base = stream_hash(settings[FLEET_SEED], int32(TRAINING))
        other = (number + int32(1) + beside) % size
        first = episode_hash(base, number, int32(rules.FLEET))
        second = episode_hash(base, other, int32(rules.FLEET))
    return int32(first) & int32(-2), int32(second) & int32(-2)


@inlined
def _begin_trip(floats: Any, integers: Any, row: Any, trip: Any, settings: Any) -> None:
    """Put the boat at the start of a trip with a full tank."""
    bits = _session_hash(settings, row, integers[EPISODE_ROW, row], int32(trip))
    start_x, start_y, goal_x, goal_y = boats.layout(bits, stream_step(int32(settings[EPISODE_STREAM])))
    floats[AT.start_x, row], floats[AT.start_y, row] = start_x, start_y
    floats[AT.goal_x, row], floats[AT.goal_y, row] = goal_x, goal_y
    floats[AT.x, row], floats[AT.y, row], floats[AT.fuel, row] = start_x, start_y, _TANK
    integers[AT.boat, row] = task.NOT_CHOSEN if settings[kernels.NUM_OPTIONS] > 0 else 0
    integers[AT.trip, row], integers[AT.presses, row] = trip, 0


@inlined
def _start(floats: Any, integers: Any, row: Any, settings: Any) -> None:
    """Begin a session in a row."""
    kernels.new_episode(integers, row, settings)
    for column in range(AT.velocity_x, AT.frame_y + 1):
        floats[column, row] = ZERO
    first, second = _draw_boats(settings, row, integers[EPISODE_ROW, row])
    integers[AT.first_boat, row], integers[AT.second_boat, row] = first, second
    integers[AT.last_boat, row], integers[AT.last_key, row] = task.NOT_CHOSEN, -1
    integers[AT.docked, row], integers[AT.trip_ended, row] = 0, 0
    _begin_trip(floats, integers, row, 0, settings)


@inlined
def _act(floats: Any, integers: Any, row: Any, option: Any, key: Any, duration: Any, settings: Any) -> Any:
    """Press a key in a row, and return the reward."""
    boat = integers[AT.boat, row]
    if boat == task.NOT_CHOSEN:
        boat = int32(option)
    steps, noise = integers[STEPS_ROW, row], _F(settings[MOTOR_NOISE])
    if noise > ZERO:
        bits, step = kernels.noise_rng(settings, row, integers[EPISODE_ROW, row])
        drawn = normal(bits, step, steps * (rules.NUMBERS_PER_PRESS // 2) + rules.MOTOR)
        duration = min(duration * _F(math.exp(noise * drawn)), _LONGEST)
    own = integers[AT.second_boat, row] if boat == 1 else integers[AT.first_boat, row]
    dir_x, dir_y = _direction(own, int32(key), settings)
    strength, glide = _strength_and_glide(own, settings)
    x, y, goal_x, goal_y = floats[AT.x, row], floats[AT.y, row], floats[AT.goal_x, row], floats[AT.goal_y, row]
    start_x, start_y = floats[AT.start_x, row], floats[AT.start_y, row]
    new_x, new_y, left, speed, outcome = boats.press(
        x,
        y,
        floats[AT.fuel, row],
        goal_x,
        goal_y,
        dir_x,
        dir_y,
        duration,
        strength,
        _GLIDE * glide,
        ONE + _GLIDE * glide,
    )
    presses = integers[AT.presses, row] + 1
    if presses >= task.MAX_PRESSES and outcome == task.SAILING:
        outcome = int32(task.TIME_LIMIT)
    docks, ends = outcome == task.SUCCESS, outcome != task.SAILING
    final = _SUCCESS * left / _TANK if docks else ZERO
    reward = final
    if settings[IS_SPARSE] == 0.0:
        before = math.sqrt((goal_x - x) ** 2 + (goal_y - y) ** 2)
        after = math.sqrt((goal_x - new_x) ** 2 + (goal_y - new_y) ** 2)
        failed = (outcome > task.SUCCESS) & (outcome < task.TIME_LIMIT)
        at_start = math.sqrt((goal_x - start_x) ** 2 + (goal_y - start_y) ** 2)
        reward = (before - after) / at_start + (_FAILURE if failed else final)
    floats[AT.x, row], floats[AT.y, row], floats[AT.fuel, row] = new_x, new_y, left
    floats[AT.velocity_x, row], floats[AT.velocity_y, row] = speed * dir_x, speed * dir_y
    floats[AT.moved_x, row], floats[AT.moved_y, row] = new_x - x, new_y - y
    floats[AT.last_duration, row] = duration
    if integers[AT.last_key, row] < 0:
        floats[AT.frame_x, row], floats[AT.frame_y, row] = new_x - x, new_y - y
        if settings[SENSOR_NOISE] > 0.0:
            bits, step = kernels.noise_rng(settings, row, integers[EPISODE_ROW, row])
            index = (steps + 1) * (rules.NUMBERS_PER_PRESS // 2) + rules.SENSOR + 6
            floats[AT.frame_x, row] += _F(settings[SENSOR_NOISE]) * normal(bits, step, index)
            floats[AT.frame_y, row] += _F(settings[SENSOR_NOISE]) * normal(bits, step, index + 1)
    integers[AT.boat, row], integers[AT.last_boat, row], integers[AT.last_key, row] = boat, boat, int32(key)
    integers[AT.presses, row], integers[STEPS_ROW, row] = presses, steps + 1
    integers[AT.trip_ended, row] = int32(ends)
    if ends:
        score = final if docks else _FAILURE
        floats[AT.last_score, row] = score
        floats[AT.total_score, row] += score
        integers[AT.docked, row] += int32(docks)
        trip = integers[AT.trip, row] + 1
        if trip < settings[TRIPS]:
            _begin_trip(floats, integers, row, trip, settings)
        else:
            integers[OUTCOME_ROW, row] = rules.FINISHED
    return reward


@inlined
def _observe(floats: Any, integers: Any, row: Any, settings: Any, observation: Any) -> None:
    """Write the observation of a row."""
    for place in range(_NUM_COORDINATES):
        observation[place] = floats[place, row]
    observation[_MOVED], observation[_MOVED + 1] = floats[AT.moved_x, row], floats[AT.moved_y, row]
    noise, last_key = _F(settings[SENSOR_NOISE]), integers[AT.last_key, row]
    if noise > ZERO:
        bits, step = kernels.noise_rng(settings, row, integers[EPISODE_ROW, row])
        index = integers[STEPS_ROW, row] * (rules.NUMBERS_PER_PRESS // 2) + rules.SENSOR
        for number in range(_NUM_COORDINATES):
            observation[number] += noise * normal(bits, step, index + number)
        if last_key >= 0:
            for axis in range(2):
                observation[_MOVED + axis] += noise * normal(bits, step, index + _NUM_COORDINATES + axis)
    for place in range(_NUM_COORDINATES):
        observation[place] *= _UNIT
    observation[_MOVED] *= _UNIT
    observation[_MOVED + 1] *= _UNIT
    observation[_VELOCITY], observation[_VELOCITY + 1] = (
        floats[AT.velocity_x, row] * _SPEED,
        floats[AT.velocity_y, row] * _SPEED,
    )
    if settings[HAS_OWN_FRAME] != 0.0:
        axis_x, axis_y = floats[AT.frame_x, row], floats[AT.frame_y, row]
        if axis_x == ZERO and axis_y == ZERO:
            axis_x = observation[AT.goal_x] - observation[AT.start_x]
            axis_y = observation[AT.goal_y] - observation[AT.start_y]
        length = max(math.sqrt(axis_x * axis_x + axis_y * axis_y), _SHORTEST_AXIS)
        cosine, sine = axis_x / length, axis_y / length
        for place in (AT.start_x, AT.goal_x, AT.x, _VELOCITY, _MOVED):
            across, along = observation[place], observation[place + 1]
            observation[place] = across * cosine + along * sine
            observation[place + 1] = along * cosine - across * sine
    to_goal_x, to_goal_y = observation[AT.goal_x] - observation[AT.x], observation[AT.goal_y] - observation[AT.y]
    across, along = observation[AT.goal_x] - observation[AT.start_x], observation[AT.goal_y] - observation[AT.start_y]
    at_start = max(math.sqrt(across * across + along * along), _NEAREST)
    observation[_TO_GOAL], observation[_TO_GOAL + 1] = to_goal_x, to_goal_y
    observation[_FUEL] = floats[AT.fuel, row] / _TANK
    observation[_DISTANCE] = math.sqrt(to_goal_x * to_goal_x + to_goal_y * to_goal_y) / at_start
    observation[_TRIP] = _F(integers[AT.trip, row]) / _F(settings[TRIPS])
    observation[_BOAT], observation[_BOAT + 1] = _F(integers[AT.boat, row]), _F(integers[AT.last_boat, row])
    for key in range(task.NUM_KEYS):
        observation[_LAST_KEY + key] = ONE if last_key == key else ZERO
    observation[_LAST_DURATION] = floats[AT.last_duration, row] / _LONGEST
    observation[_LAST_SCORE] = floats[AT.last_score, row] / _SUCCESS


@kernel
def advance(
    state: Any, option: Any, discrete: Any, parameters: Any, mask: Any, settings: Any, mode: Any, results: Any
) -> int:
    """Act or restart in every row, in place; see `hpamdp.env.kernel_rows`."""
    floats, integers = state
    observations, outcomes, extras, flags, rewards = results
    invalid = kernels.invalid_row(option, discrete, parameters, integers, settings, mode)
    if invalid >= 0:
        return invalid
    trips = _F(settings[TRIPS])
    for row in range(len(mask)):
        was_over = integers[OUTCOME_ROW, row] != rules.GOING_ON
        if mode != kernels.RESTART and mask[row] and not was_over:
            duration = kernels.parameter(parameters, row, 0, discrete[row])
            rewards[row] = _act(floats, integers, row, option[row], discrete[row], duration, settings)
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                _start(floats, integers, row, settings)
            _observe(floats, integers, row, settings, observations[reading, row])
            extras[reading, 0, row] = _F(integers[AT.trip_ended, row])
            extras[reading, 1, row] = floats[AT.total_score, row] / trips
            extras[reading, 2, row] = _F(integers[AT.docked, row]) / trips
            kernels.report(integers[OUTCOME_ROW, row], len(rules.OUTCOMES), row, outcomes[reading], flags[reading])
    return -1
