"""The boats' rules for one row, and the loops over all rows that Numba compiles: a step, a reset, a reading.

Closed forms of the motion, which planners, films and replays need, are in `physics`, for columns. The tests compare
this module with tensor functions in experiments/whole_map/boat_rules.py.

Rows pass through a step in blocks that stay in the processor's cache. The loops over a block have no branches, so the
compiler turns them into vector instructions. That is why conditions are values, and why the columns lie in one flat
scratch array, where the compiler sees that two columns never overlap.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import int32

from hpamdp.env.boatdock import task
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.kernels import (
    ACT_OR_RESTART,
    EPISODE_STREAM,
    FIRST_ENV,
    HALF,
    NOISE_STREAM,
    ONE,
    OWN,
    RESTART,
    SEED,
    TURN,
    TWO,
    ZERO,
    episode_hash,
    inlined,
    invalid_row,
    kernel,
    normal,
    part,
    sin_cos,
    stream_hash,
    stream_step,
    uniform,
    unsigned,
)

# Rows of the state's two arrays, float32 [9, N] and int32 [5, N], in the order of BoatState.
START_X, START_Y, GOAL_X, GOAL_Y, X, Y, VELOCITY_X, VELOCITY_Y, FUEL = range(9)
CONTROLLER, KEYMAP, PRESSES, OUTCOME, EPISODE = range(5)

# Places of the boats' own settings in the float64 array of settings.
(
    SET_CONTROLLER,
    SET_KEYMAP,
    IS_SPARSE,
    IS_PIXELS,
    SENSOR_NOISE,
    SLIP_CHANCE,
    NUM_BOATS,
    HAS_KEYMAPS,
    SWITCH_COST,
) = range(OWN, OWN + 9)
FIRST_BOAT = OWN + 9
# From FIRST_BOAT on, each boat has its motor noise and then x and y of each key. If HAS_KEYMAPS is set, the directions
# follow from the key map instead.
NUM_BOAT_SETTINGS = 7
RANDOM = -2  # value of SET_CONTROLLER and SET_KEYMAP

_BLOCK = 128

# Columns of the float32 scratch: the state's nine, then these. Sixteen columns of the observation start at _SEEN.
_DURATION, _REWARD, _SEEN = 9, 10, 11
_DIR_X, _DIR_Y = _SEEN, _SEEN + 1
_NUM_FLOATS = 27
# Columns of the int32 scratch: the state's five, the key, the option, whether the row moves, whether it restarts, the
# bits of its episode's random-number key, and whether the last try at a layout was too near.
_KEY, _OPTION, _MOVES, _IS_NEW, _BITS, _IS_NEAR = 5, 6, 7, 8, 9, 10
_NUM_INTEGERS = 11

_F = np.float32
_CUBIC, _QUARTIC = _F(100.0 / 3.0), _F(5.0 / 3.0)
_SQUARE, _CUBE = _F(100.0), _F(20.0 / 3.0)
GLIDE, PRESS_AND_GLIDE = _F(task.GLIDE), _F(1.0 + task.GLIDE)
_LONGEST, _TANK, _DRY = _F(task.MAX_DURATION), _F(task.TANK), _F(task.DRY)
_DOCK_SQUARED, _HARBOUR_SQUARED = _F(task.DOCK_RADIUS**2), _F(task.HARBOUR_RADIUS**2)
_DOCK, _HARBOUR, _LAYOUT = _F(task.DOCK_RADIUS), _F(task.HARBOUR_RADIUS), _F(task.LAYOUT_RADIUS)
_DOCKING_SPEED = _F(task.DOCKING_SPEED)
_NEAR = _F((task.MIN_SEPARATION / task.LAYOUT_RADIUS) ** 2)
_FAR = _F(np.inf)
_COS30 = _F(math.sqrt(3.0) / 2.0)
_SUCCESS, _FAILURE = _F(task.SUCCESS_REWARD), _F(task.FAILURE_REWARD)
_LENGTH, _SPEED = _F(1.0 / task.HARBOUR_RADIUS), _F(1.0 / task.SPEED_SCALE)
_CENTRE_X, _CENTRE_Y = _F(task.CENTRE[0]), _F(task.CENTRE[1])
_PI, _QUARTER = _F(math.pi), _F(0.25)
# A third of a float's bits plus this constant are approximately the bits of its cube root.
_ROOT_BITS = np.int32(709921077)


@inlined
def _speed(duration: Any) -> Any:
    return duration * duration * (_SQUARE - _CUBE * duration)


@inlined
def _pressed_distance(duration: Any) -> Any:
    return duration * duration * duration * (_CUBIC - _QUARTIC * duration)


@inlined
def _duration_for(distance: Any) -> Any:
    """Invert the distance by Newton's method. It starts from a rough cube root, refined by Halley's method."""
    cubed = np.float32(_F(0.03) * distance + _F(1e-12))
    root = np.int32(cubed.view(np.int32) // np.int32(3) + _ROOT_BITS).view(np.float32)
    power = root * root * root
    root = root * (power + TWO * cubed) / (TWO * power + cubed)
    duration = root * (ONE + root / _F(60.0))
    duration -= (_pressed_distance(duration) - distance) / _speed(duration)
    duration -= (_pressed_distance(duration) - distance) / _speed(duration)
    duration -= (_pressed_distance(duration) - distance) / _speed(duration)
    return max(duration, ZERO)


@inlined
def _length(x: Any, y: Any) -> Any:
    return math.sqrt(x * x + y * y)


@inlined
def press(
    x: Any,
    y: Any,
    fuel: Any,
    goal_x: Any,
    goal_y: Any,
    dir_x: Any,
    dir_y: Any,
    duration: Any,
    strength: Any = ONE,
    glide: Any = GLIDE,
    whole: Any = PRESS_AND_GLIDE,
) -> Any:
    """Return x, y, fuel, speed and outcome after a press, as `physics.press` does for columns.

    Args:
        x, y, fuel, goal_x, goal_y, dir_x, dir_y, duration: of the row.
        strength: its speed, as a multiple of that of people's boats.
        glide: length of the glide, as a multiple of the way while the key is down.
        whole: 1 + `glide`.
    """
    duration = min(duration, fuel)
    pressed = strength * _pressed_distance(duration)
    total = whole * pressed
    ahead = (goal_x - x) * dir_x + (goal_y - y) * dir_y
    aside = (goal_x - x) * dir_y - (goal_y - y) * dir_x
    half_chord_squared = _DOCK_SQUARED - aside * aside
    entry = max(ahead - math.sqrt(max(half_chord_squared, ZERO)), ZERO)
    to_dock = entry if (half_chord_squared >= ZERO) & (ahead > ZERO) else _FAR
    ahead = x * dir_x + y * dir_y
    aside = x * dir_y - y * dir_x
    to_harbour = max(math.sqrt(max(_HARBOUR_SQUARED - aside * aside, ZERO)) - ahead, ZERO)
    docks = (to_dock <= total) & (to_dock <= to_harbour)
    leaves = (to_harbour < total) & (not docks)
    travelled = to_dock if docks else (to_harbour if leaves else total)
    in_glide = travelled > pressed
    virtual = min(_duration_for(((total - travelled) / glide if in_glide else travelled) / strength), duration)
    burnt = duration if in_glide else virtual
    left = fuel - burnt
    left = left if left > _DRY else ZERO
    docked = task.SUCCESS if strength * _speed(virtual) <= _DOCKING_SPEED else task.TOO_FAST
    rested = task.SAILING if left > ZERO else task.OUT_OF_FUEL
    outcome = docked if docks else (task.OUT_OF_BOUNDS if leaves else rested)
    return x + travelled * dir_x, y + travelled * dir_y, left, strength * _speed(burnt), int32(outcome)


@inlined
def _direction(controller: Any, keymap: Any, key: Any) -> Any:
    """Return the unit direction of a key, as `harbour.direction` does for columns."""
    first = int32(0) if key == 0 else int32(3 - key)
    second = int32(2) if key == 2 else int32(1 - key)
    reordered = first if keymap == 1 else second
    is_congruent = controller == task.CONGRUENT
    column = int32(key) if is_congruent else reordered
    sign = ONE if is_congruent else -ONE
    return sign * _COS30 * _F(int32(column - 1)), sign * (-ONE if column == 1 else HALF)


@inlined
def _attempt(bits: Any, step: Any, first: Any) -> Any:
    """Return the squared radii of start and goal, the angle between them, and whether they are too near."""
    start, goal = uniform(bits, step, first), uniform(bits, step, first + 1)
    turn = TURN * uniform(bits, step, first + 2)
    return start, goal, turn, start + goal - TWO * math.sqrt(start * goal) * sin_cos(turn)[1] < _NEAR


@inlined
def layout(bits: Any, step: Any) -> Any:
    """Return start x, start y, goal x and goal y of a row's layout, as `harbour.sample_layout` does for columns."""
    start, goal, turn, is_near = _attempt(bits, step, 0)
    for attempt in range(1, task.LAYOUT_TRIES):
        if is_near:
            start, goal, turn, is_near = _attempt(bits, step, 3 * attempt)
    if is_near:
        goal, turn = _QUARTER, _PI
    angle = TURN * uniform(bits, step, task.INDEX_ANGLE)
    start_radius, goal_radius = _LAYOUT * math.sqrt(start), _LAYOUT * math.sqrt(goal)
    start_sin, start_cos = sin_cos(angle)
    goal_sin, goal_cos = sin_cos(angle + turn)
    return start_radius * start_cos, start_radius * start_sin, goal_radius * goal_cos, goal_radius * goal_sin


@part
def _load(floats: Any, integers: Any, mask: Any, first: Any, count: Any, scratch: Any, numbers: Any) -> None:
    for column in range(9):
        for j in range(count):
            scratch[column * _BLOCK + j] = floats[column, unsigned(first + j)]
    for column in range(5):
        for j in range(count):
            numbers[column * _BLOCK + j] = integers[column, unsigned(first + j)]
    for j in range(count):
        numbers[_MOVES * _BLOCK + j] = mask[unsigned(first + j)]
        numbers[_IS_NEW * _BLOCK + j] = mask[unsigned(first + j)]


@part
def _mark_over(count: Any, numbers: Any) -> None:
    """Mark the rows whose episode is over for a restart."""
    for j in range(count):
        numbers[_IS_NEW * _BLOCK + j] = int32(numbers[OUTCOME * _BLOCK + j] != task.SAILING)


@part
def _load_actions(
    option: Any, key: Any, durations: Any, first: Any, count: Any, scratch: Any, numbers: Any, settings: Any
) -> None:
    last_boat = int32(settings[NUM_BOATS] - 1.0)
    for j in range(count):
        # Clip keys and options, because ignored actions may have any value.
        row = unsigned(first + j)
        pressed = int32(min(max(key[row], 0), task.NUM_KEYS - 1))
        numbers[_KEY * _BLOCK + j] = pressed
        numbers[_OPTION * _BLOCK + j] = int32(min(max(option[row], 0), last_boat))
        scratch[_DURATION * _BLOCK + j] = min(max(durations[row, pressed], ZERO), _LONGEST)


@part
def _store(floats: Any, integers: Any, first: Any, count: Any, scratch: Any, numbers: Any) -> None:
    for column in range(9):
        for j in range(count):
            floats[column, unsigned(first + j)] = scratch[column * _BLOCK + j]
    for column in range(5):
        for j in range(count):
            integers[column, unsigned(first + j)] = numbers[column * _BLOCK + j]


@part
def _has_motor_noise(settings: Any) -> Any:
    """Return whether the presses of any boat vary."""
    has_noise = False
    for boat in range(int(settings[NUM_BOATS])):
        has_noise |= settings[FIRST_BOAT + boat * NUM_BOAT_SETTINGS] > 0.0
    return has_noise


@part
def _switch(count: Any, scratch: Any, numbers: Any, settings: Any) -> None:
    """Change to the option's boat if another one is held, and take the fuel that the change costs."""
    cost = _F(settings[SWITCH_COST])
    for j in range(count):
        held, option = numbers[CONTROLLER * _BLOCK + j], numbers[_OPTION * _BLOCK + j]
        moves = (numbers[_MOVES * _BLOCK + j] != 0) & (numbers[OUTCOME * _BLOCK + j] == task.SAILING)
        if moves & (held != task.NOT_CHOSEN) & (held != option):
            numbers[CONTROLLER * _BLOCK + j] = option
            scratch[FUEL * _BLOCK + j] = max(scratch[FUEL * _BLOCK + j] - cost, ZERO)


@inlined
def _controller(numbers: Any, j: Any) -> Any:
    """Return the held controller of a row, or the chosen one if the row holds none."""
    held = numbers[CONTROLLER * _BLOCK + j]
    return numbers[_OPTION * _BLOCK + j] if held == task.NOT_CHOSEN else held


@part
def _aim(count: Any, scratch: Any, numbers: Any, settings: Any) -> None:
    """Write the directions of the keys to two columns of the scratch that are free at this point."""
    if settings[HAS_KEYMAPS] != 0.0:
        for j in range(count):
            dir_x, dir_y = _direction(_controller(numbers, j), numbers[KEYMAP * _BLOCK + j], numbers[_KEY * _BLOCK + j])
            scratch[_DIR_X * _BLOCK + j], scratch[_DIR_Y * _BLOCK + j] = dir_x, dir_y
        return
    for j in range(count):
        place = FIRST_BOAT + _controller(numbers, j) * NUM_BOAT_SETTINGS + 1 + 2 * numbers[_KEY * _BLOCK + j]
        scratch[_DIR_X * _BLOCK + j], scratch[_DIR_Y * _BLOCK + j] = _F(settings[place]), _F(settings[place + 1])


@part
def _disturb(first: Any, count: Any, scratch: Any, numbers: Any, settings: Any) -> None:
    """Apply slips of keys and motor noise."""
    base = stream_hash(settings[SEED], int32(settings[NOISE_STREAM]))
    step = stream_step(int32(settings[NOISE_STREAM]))
    slip = _F(settings[SLIP_CHANCE])
    has_motor_noise = _has_motor_noise(settings)
    for j in range(count):
        environment = int32(settings[FIRST_ENV]) + first + j
        bits = episode_hash(base, environment, numbers[EPISODE * _BLOCK + j])
        index = numbers[PRESSES * _BLOCK + j] * task.NUMBERS_PER_PRESS
        if slip > ZERO and uniform(bits, step, index + task.SLIP) < slip:
            drawn = uniform(bits, step, index + task.SLIPPED_KEY) * _F(task.NUM_KEYS)
            numbers[_KEY * _BLOCK + j] = int32(drawn)
        if has_motor_noise:
            deviation = _F(settings[FIRST_BOAT + _controller(numbers, j) * NUM_BOAT_SETTINGS])
            factor = _F(math.exp(deviation * normal(bits, step, index // 2 + task.MOTOR)))
            scratch[_DURATION * _BLOCK + j] = min(scratch[_DURATION * _BLOCK + j] * factor, _LONGEST)


@part
def _press_block(first: Any, count: Any, scratch: Any, numbers: Any, settings: Any, rewards: Any) -> None:
    """Press a key in every row that moves."""
    is_sparse = settings[IS_SPARSE] != 0.0
    for j in range(count):
        x, y, fuel = scratch[X * _BLOCK + j], scratch[Y * _BLOCK + j], scratch[FUEL * _BLOCK + j]
        goal_x, goal_y = scratch[GOAL_X * _BLOCK + j], scratch[GOAL_Y * _BLOCK + j]
        start_x, start_y = scratch[START_X * _BLOCK + j], scratch[START_Y * _BLOCK + j]
        old_vx, old_vy = scratch[VELOCITY_X * _BLOCK + j], scratch[VELOCITY_Y * _BLOCK + j]
        held = numbers[CONTROLLER * _BLOCK + j]
        presses, old_outcome = numbers[PRESSES * _BLOCK + j], numbers[OUTCOME * _BLOCK + j]
        moves = (numbers[_MOVES * _BLOCK + j] != 0) & (old_outcome == task.SAILING)

        dir_x, dir_y = scratch[_DIR_X * _BLOCK + j], scratch[_DIR_Y * _BLOCK + j]
        new_x, new_y, left, speed, outcome = press(
            x, y, fuel, goal_x, goal_y, dir_x, dir_y, scratch[_DURATION * _BLOCK + j]
        )
        is_late = (presses + 1 >= task.MAX_PRESSES) & (outcome == task.SAILING)
        outcome = int32(task.TIME_LIMIT) if is_late else outcome

        before, after = _length(goal_x - x, goal_y - y), _length(goal_x - new_x, goal_y - new_y)
        progress = (before - after) / _length(goal_x - start_x, goal_y - start_y)
        final = _SUCCESS * left / _TANK if outcome == task.SUCCESS else ZERO
        failed = (outcome > task.SUCCESS) & (outcome < task.TIME_LIMIT)
        reward = final if is_sparse else progress + (_FAILURE if failed else final)

        scratch[X * _BLOCK + j] = new_x if moves else x
        scratch[Y * _BLOCK + j] = new_y if moves else y
        scratch[VELOCITY_X * _BLOCK + j] = speed * dir_x if moves else old_vx
        scratch[VELOCITY_Y * _BLOCK + j] = speed * dir_y if moves else old_vy
        scratch[FUEL * _BLOCK + j] = left if moves else fuel
        scratch[_REWARD * _BLOCK + j] = reward if moves else ZERO
        numbers[CONTROLLER * _BLOCK + j] = _controller(numbers, j) if moves else held
        numbers[PRESSES * _BLOCK + j] = int32(presses + 1) if moves else presses
        numbers[OUTCOME * _BLOCK + j] = outcome if moves else old_outcome
    for j in range(count):
        rewards[unsigned(first + j)] = scratch[_REWARD * _BLOCK + j]


@part
def _restart(first: Any, count: Any, scratch: Any, numbers: Any, settings: Any) -> None:
    """Start new episodes in the marked rows of a block, with layouts as of `harbour.sample_layout`."""
    base = stream_hash(settings[SEED], int32(settings[EPISODE_STREAM]))
    step = stream_step(int32(settings[EPISODE_STREAM]))
    first_env = int32(settings[FIRST_ENV]) + int32(first)
    start_at, goal_at, turn_at = _SEEN * _BLOCK, (_SEEN + 1) * _BLOCK, (_SEEN + 2) * _BLOCK  # free at this point
    is_any = 0
    for j in range(count):
        is_any |= numbers[_IS_NEW * _BLOCK + j]
    if is_any == 0:
        return
    for j in range(count):
        bits = episode_hash(base, first_env + int32(j), numbers[EPISODE * _BLOCK + j] + int32(1))
        start, goal, turn, is_near = _attempt(bits, step, 0)
        scratch[start_at + j], scratch[goal_at + j], scratch[turn_at + j] = start, goal, turn
        numbers[_BITS * _BLOCK + j] = int32(bits)
        numbers[_IS_NEAR * _BLOCK + j] = int32(is_near)
    for j in range(count):
        if numbers[_IS_NEAR * _BLOCK + j] & numbers[_IS_NEW * _BLOCK + j]:
            for attempt in range(1, task.LAYOUT_TRIES):
                start, goal, turn, is_near = _attempt(numbers[_BITS * _BLOCK + j], step, 3 * attempt)
                if not is_near:
                    break
                goal, turn = _QUARTER, _PI  # if the last try fails, the goal lies on the far side of the centre
            scratch[start_at + j], scratch[goal_at + j], scratch[turn_at + j] = start, goal, turn
    chosen, keymap = int32(settings[SET_CONTROLLER]), int32(settings[SET_KEYMAP])
    num_boats, last_boat = _F(settings[NUM_BOATS]), int32(settings[NUM_BOATS] - 1.0)
    draws_controller, draws_keymap = chosen == RANDOM, keymap == RANDOM
    for j in range(count):
        bits = numbers[_BITS * _BLOCK + j]
        angle = TURN * uniform(bits, step, task.INDEX_ANGLE)
        start_radius = _LAYOUT * math.sqrt(scratch[start_at + j])
        goal_radius = _LAYOUT * math.sqrt(scratch[goal_at + j])
        start_sin, start_cos = sin_cos(angle)
        goal_sin, goal_cos = sin_cos(angle + scratch[turn_at + j])
        is_new = numbers[_IS_NEW * _BLOCK + j] != 0
        start_x = start_radius * start_cos if is_new else scratch[START_X * _BLOCK + j]
        start_y = start_radius * start_sin if is_new else scratch[START_Y * _BLOCK + j]
        scratch[START_X * _BLOCK + j], scratch[START_Y * _BLOCK + j] = start_x, start_y
        goal_x, goal_y = scratch[GOAL_X * _BLOCK + j], scratch[GOAL_Y * _BLOCK + j]
        scratch[GOAL_X * _BLOCK + j] = goal_radius * goal_cos if is_new else goal_x
        scratch[GOAL_Y * _BLOCK + j] = goal_radius * goal_sin if is_new else goal_y
        x, y, fuel = scratch[X * _BLOCK + j], scratch[Y * _BLOCK + j], scratch[FUEL * _BLOCK + j]
        velocity_x, velocity_y = scratch[VELOCITY_X * _BLOCK + j], scratch[VELOCITY_Y * _BLOCK + j]
        scratch[X * _BLOCK + j] = start_x if is_new else x
        scratch[Y * _BLOCK + j] = start_y if is_new else y
        scratch[VELOCITY_X * _BLOCK + j] = ZERO if is_new else velocity_x
        scratch[VELOCITY_Y * _BLOCK + j] = ZERO if is_new else velocity_y
        scratch[FUEL * _BLOCK + j] = _TANK if is_new else fuel
        presses, outcome = numbers[PRESSES * _BLOCK + j], numbers[OUTCOME * _BLOCK + j]
        numbers[PRESSES * _BLOCK + j] = int32(0) if is_new else presses
        numbers[OUTCOME * _BLOCK + j] = int32(task.SAILING) if is_new else outcome
        numbers[EPISODE * _BLOCK + j] += numbers[_IS_NEW * _BLOCK + j]
        held, held_keymap = numbers[CONTROLLER * _BLOCK + j], numbers[KEYMAP * _BLOCK + j]
        drawn = max(last_boat - int32(uniform(bits, step, task.INDEX_CONTROLLER) * num_boats), int32(0))
        controller = drawn if draws_controller else chosen
        drawn_keymap = int32(1) + int32(uniform(bits, step, task.INDEX_KEYMAP) < HALF)
        new_keymap = drawn_keymap if draws_keymap else keymap
        numbers[CONTROLLER * _BLOCK + j] = controller if is_new else held
        numbers[KEYMAP * _BLOCK + j] = new_keymap if is_new else held_keymap


@part
def _add_sensor_noise(first: Any, count: Any, scratch: Any, numbers: Any, settings: Any) -> None:
    """Write the six coordinates with sensor noise to the first columns of the observation."""
    deviation = _F(settings[SENSOR_NOISE])
    base = stream_hash(settings[SEED], int32(settings[NOISE_STREAM]))
    step = stream_step(int32(settings[NOISE_STREAM]))
    for j in range(count):
        environment = int32(settings[FIRST_ENV]) + first + j
        bits = episode_hash(base, environment, numbers[EPISODE * _BLOCK + j])
        index = numbers[PRESSES * _BLOCK + j] * (task.NUMBERS_PER_PRESS // 2) + task.SENSOR
        for i in range(6):
            scratch[(_SEEN + i) * _BLOCK + j] = scratch[i * _BLOCK + j] + deviation * normal(bits, step, index + i)


@part
def _observe(first: Any, count: Any, scratch: Any, numbers: Any, settings: Any, observation: Any) -> None:
    """Write the observations of a block."""
    # The six coordinates are read from the first columns of the state or, if the sensors are noisy, of the observation.
    seen = 0
    if settings[SENSOR_NOISE] > 0.0:
        _add_sensor_noise(first, count, scratch, numbers, settings)
        seen = _SEEN * _BLOCK
    is_pixels = settings[IS_PIXELS] != 0.0
    length, unit = (ONE, ONE) if is_pixels else (_LENGTH, _SPEED)
    centre_x, centre_y = (_CENTRE_X, _CENTRE_Y) if is_pixels else (ZERO, ZERO)
    for j in range(count):
        start_x, start_y = scratch[seen + j], scratch[seen + _BLOCK + j]
        goal_x, goal_y = scratch[seen + 2 * _BLOCK + j], scratch[seen + 3 * _BLOCK + j]
        x, y = scratch[seen + 4 * _BLOCK + j], scratch[seen + 5 * _BLOCK + j]
        at_start = max(_length(goal_x - start_x, goal_y - start_y), _DOCK)
        distance = _length(goal_x - x, goal_y - y) / at_start
        scratch[_SEEN * _BLOCK + j] = start_x * length + centre_x
        scratch[(_SEEN + 1) * _BLOCK + j] = start_y * length + centre_y
        scratch[(_SEEN + 2) * _BLOCK + j] = goal_x * length + centre_x
        scratch[(_SEEN + 3) * _BLOCK + j] = goal_y * length + centre_y
        scratch[(_SEEN + 4) * _BLOCK + j] = centre_x
        scratch[(_SEEN + 5) * _BLOCK + j] = centre_y
        scratch[(_SEEN + 6) * _BLOCK + j] = _HARBOUR * length
        scratch[(_SEEN + 7) * _BLOCK + j] = _F(numbers[CONTROLLER * _BLOCK + j])
        scratch[(_SEEN + 8) * _BLOCK + j] = x * length + centre_x
        scratch[(_SEEN + 9) * _BLOCK + j] = y * length + centre_y
        scratch[(_SEEN + 10) * _BLOCK + j] = scratch[VELOCITY_X * _BLOCK + j] * unit
        scratch[(_SEEN + 11) * _BLOCK + j] = scratch[VELOCITY_Y * _BLOCK + j] * unit
        scratch[(_SEEN + 12) * _BLOCK + j] = scratch[FUEL * _BLOCK + j] / _TANK
        scratch[(_SEEN + 13) * _BLOCK + j] = distance
        scratch[(_SEEN + 14) * _BLOCK + j] = (goal_x - x) * length
        scratch[(_SEEN + 15) * _BLOCK + j] = (goal_y - y) * length
    for j in range(count):
        row = unsigned(first + j)
        for column in range(14):
            observation[row, column] = scratch[(_SEEN + column) * _BLOCK + j]
        if not is_pixels:
            observation[row, 14] = scratch[(_SEEN + 14) * _BLOCK + j]
            observation[row, 15] = scratch[(_SEEN + 15) * _BLOCK + j]


@part
def _report(first: Any, count: Any, scratch: Any, numbers: Any, outcomes: Any, fuel: Any, flags: Any) -> None:
    """Write outcomes, fractions of fuel, and the flags done, terminated and truncated."""
    for j in range(count):
        row, outcome = unsigned(first + j), numbers[OUTCOME * _BLOCK + j]
        outcomes[row] = outcome
        fuel[row] = scratch[FUEL * _BLOCK + j] / _TANK
        is_late = outcome == task.TIME_LIMIT
        is_done = outcome != task.SAILING
        flags[0, row] = is_done
        flags[1, row] = is_done & (not is_late)
        flags[2, row] = is_late


@kernel
def advance(
    state: Any, option: Any, discrete: Any, parameters: Any, mask: Any, settings: Any, mode: Any, results: Any
) -> int:
    """Press or restart in every row, in place; see `hpamdp.env.kernel_rows`. The only extra is the fraction of fuel."""
    floats, integers = state
    observations, outcomes, extras, flags, rewards = results
    invalid = invalid_row(option, discrete, parameters, integers, settings, mode)
    if invalid >= 0:
        return invalid
    scratch = np.empty(_NUM_FLOATS * _BLOCK, np.float32)
    numbers = np.empty(_NUM_INTEGERS * _BLOCK, np.int32)
    has_noise = (settings[SLIP_CHANCE] > 0.0) | _has_motor_noise(settings)
    for first in range(0, len(mask), _BLOCK):
        count = min(_BLOCK, len(mask) - first)
        _load(floats, integers, mask, first, count, scratch, numbers)
        if mode == ACT_OR_RESTART:
            _mark_over(count, numbers)
        if mode != RESTART:
            _load_actions(option, discrete, parameters[0], first, count, scratch, numbers, settings)
            if settings[SWITCH_COST] >= 0.0:
                _switch(count, scratch, numbers, settings)
            if has_noise:
                _disturb(first, count, scratch, numbers, settings)
            _aim(count, scratch, numbers, settings)
            _press_block(first, count, scratch, numbers, settings, rewards)
        for reading in range(len(observations)):
            if reading == 1:
                _mark_over(count, numbers)
            if reading == 1 or mode in (RESTART, ACT_OR_RESTART):
                _restart(first, count, scratch, numbers, settings)
            _observe(first, count, scratch, numbers, settings, observations[reading])
            _report(first, count, scratch, numbers, outcomes[reading], extras[reading, 0], flags[reading])
        _store(floats, integers, first, count, scratch, numbers)
    return -1


def settings_of(rules: BoatDockOptions) -> list[float]:
    """Return the boats' own settings for the kernel."""
    special = {"choose": task.NOT_CHOSEN, "random": RANDOM}
    chosen = rules.controller
    boats: np.ndarray = np.zeros((len(rules.names), NUM_BOAT_SETTINGS))
    boats[:, 0] = rules.noises
    own = rules.own_boats
    if own is not None:
        boats[:, 1:] = np.array(own.directions).reshape(len(rules.names), -1)
    return [
        special[chosen] if chosen in special else rules.names.index(chosen),
        RANDOM if rules.keymap == "random" else rules.keymap,
        rules.reward == "sparse",
        rules.observation == "pixels",
        rules.sensor_noise,
        rules.slip,
        len(rules.names),
        rules.boats is None,
        -1.0 if rules.switch_cost is None else rules.switch_cost,
        *boats.reshape(-1).tolist(),
    ]
