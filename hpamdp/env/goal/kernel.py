"""The rules of Goal and Hard Goal as loops over rows that Numba compiles.

A test compares it with the tensor functions in experiments/domains/published_rules. Ticks are played in lanes, a row in
each: a tick of all lanes is loops without branches, which become vector instructions. Where an action is over, the next
row takes the lane, so that no row waits for another's. Every lane does the same, so that no row depends on its lane.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import int32, uint32

from hpamdp.env import kernels
from hpamdp.env.goal import rules
from hpamdp.env.kernels import (
    EPISODE_ROW,
    HALF,
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
)

# The problem's own settings.
NOISE, IS_SCALED, KICKS_TO_POINT, REPAIRS_DISTANCE, REPAIRS_PROJECTION, HAS_MIDDLE, IS_HARD = range(
    kernels.OWN, kernels.OWN + 7
)

# Where each column of the state is: its row, and the place among the first columns of the lanes.
AT: Any = rules.GoalState._make((*range(14), STEPS_ROW, OUTCOME_ROW, EPISODE_ROW))
_NUM_COLUMNS = len(rules.COLUMNS)

_LANES = 16  # as many as the widest vectors have float32
# Further columns of the lanes' float32: where the action aims, and the random numbers of a tick.
_AIM_X, _AIM_Y, _DRAWN = range(_NUM_COLUMNS, _NUM_COLUMNS + 3)
_NUM_FLOATS = _DRAWN + rules.NUMBERS_PER_TICK
# Columns of the lanes' int32: the row (-1 in an empty lane), whether its action is a kick, the bits of its key, the
# index of its next random number, and the end.
_ROW, _IS_KICK, _BITS, _INDEX, _END = range(5)
_NUM_INTEGERS = _END + 1
_GOING = np.int32(rules._GOING)

_F = np.float32
_LENGTH, _HALF_WIDTH, _POST = _F(rules.LENGTH), _F(rules.HALF_WIDTH), _F(rules.GOAL_HALF_WIDTH)
_DEPTH = _F(rules.LENGTH + rules.GOAL_DEPTH)
_REACH, _REACH_WITH_SLACK = _F(rules.REACH), _F(rules.REACH + rules._REACH_SLACK)
_REACH_WITH_SLACK_2 = _F((rules.REACH + rules._REACH_SLACK) ** 2)
_COAST, _COASTED, _TURNS = _F(rules._COAST), _F(1.0 / rules._COAST), _F(0.5 / math.pi)
_STILL_2, _CATCH_2 = _F(rules._STILL**2), _F(rules.CATCH**2)
_DASH, _SAVE, _FOLLOW = _F(rules._DASH), _F(rules._SAVE), _F(rules._FOLLOW)
_PLAYER_NOISE, _BALL_NOISE = _F(rules._PLAYER_NOISE), _F(rules._BALL_NOISE)
_PLAYER_SPEED, _BALL_SPEED = _F(rules._PLAYER_SPEED), _F(rules._BALL_SPEED)
_PLAYER_DECAY, _BALL_DECAY = _F(rules._PLAYER_DECAY), _F(rules._BALL_DECAY)
_KICK = _F(rules._MAX_POWER * rules._BALL_RATE)
_FACING, _KEEPER_START = _F(rules._FACING), _F(rules._KEEPER_START)
_ANGLE_LOSS, _DISTANCE_LOSS = _F(0.25 / math.pi), _F(0.25 / rules.REACH)
_SAVED = _F(rules.GOAL_HALF_WIDTH + rules._KEEPER_MARGIN)
_SHOT_X = _F(rules.LENGTH + rules._SHOT_DEPTH)
_PLAYERS, _PLAYER_BALL = _F(rules.PLAYER_SIZE + rules.KEEPER_SIZE), _F(rules.PLAYER_SIZE + rules.BALL_SIZE)
_KEEPER_BALL = _F(rules.KEEPER_SIZE + rules.BALL_SIZE)
_FIVE, _TINY = _F(5.0), _F(1e-12)
_GOAL_REWARD = _F(rules.GOAL_REWARD)
_FLOAT32_GOAL = _F(rules._FLOAT32_GOAL)
_LOW, _HIGH = np.array(rules.OBSERVATION_LOW, np.float32), np.array(rules.OBSERVATION_HIGH, np.float32)
_STRETCHES = np.array(rules.STRETCHES, np.float32)
_REPAIRED = np.array([*rules.STRETCHES[:2], rules.REPAIRED_MIDDLE, *rules.STRETCHES[3:]], np.float32)


@inlined
def _squared(x: Any, y: Any) -> Any:
    return x * x + y * y


@inlined
def _length(x: Any, y: Any) -> Any:
    return math.sqrt(_squared(x, y))


@inlined
def _clip(value: Any, limit: Any) -> Any:
    return min(max(value, -limit), limit)


@inlined
def _pushed(
    vx: Any, vy: Any, effort: Any, angle: Any, drawn: Any, drawn_x: Any, drawn_y: Any, noise: Any, limit: Any
) -> Any:
    """Return a velocity after a push."""
    sin, cos = sin_cos(angle + angle * noise * drawn)
    jolt = noise * _length(vx, vy)
    push_x = _clip(effort * cos + jolt * drawn_x, limit)
    push_y = _clip(effort * sin + jolt * drawn_y, limit)
    return _clip(vx + push_x, limit), _clip(vy + push_y, limit)


@inlined
def _draw(lanes: Any, numbers: Any, j: Any, step: Any) -> None:
    """Draw the random numbers in (-1, 1) of a tick."""
    bits, index = uint32(numbers[_BITS * _LANES + j]), numbers[_INDEX * _LANES + j]
    for place in range(rules.NUMBERS_PER_TICK):
        lanes[(_DRAWN + place) * _LANES + j] = TWO * kernels.uniform(bits, step, index + place) - ONE
    numbers[_INDEX * _LANES + j] = int32(index + rules.NUMBERS_PER_TICK)


@inlined
def _play(lanes: Any, j: Any, noise: Any) -> None:
    """Let the players move."""
    player_noise, ball_noise = noise * _PLAYER_NOISE, noise * _BALL_NOISE
    player_x, player_y = lanes[AT.player_x * _LANES + j], lanes[AT.player_y * _LANES + j]
    player_vx, player_vy = lanes[AT.player_vx * _LANES + j], lanes[AT.player_vy * _LANES + j]
    ball_vx, ball_vy = lanes[AT.ball_vx * _LANES + j], lanes[AT.ball_vy * _LANES + j]
    angle = lanes[AT.player_angle * _LANES + j]
    to_x, to_y = lanes[AT.ball_x * _LANES + j] - player_x, lanes[AT.ball_y * _LANES + j] - player_y
    distance = _length(to_x, to_y)
    turn = atan2(to_y, to_x) - angle
    turn -= TURN * _F(np.rint(_TURNS * turn))
    off = abs(turn)
    in_reach = distance <= _REACH_WITH_SLACK
    is_dash = (off < _FACING) & (not in_reach)
    is_turn = (not in_reach) & (not is_dash)
    wish_x = _COAST * (lanes[_AIM_X * _LANES + j] - player_x) - ball_vx
    wish_y = _COAST * (lanes[_AIM_Y * _LANES + j] - player_y) - ball_vy
    efficiency = ONE - _ANGLE_LOSS * off - _DISTANCE_LOSS * distance
    kick = min(_length(wish_x, wish_y), _KICK * efficiency)
    kick_angle = atan2(wish_y, wish_x)
    pushed_x, pushed_y = _pushed(
        ball_vx if in_reach else player_vx,
        ball_vy if in_reach else player_vy,
        kick if in_reach else _DASH,
        kick_angle if in_reach else angle,
        lanes[_DRAWN * _LANES + j],
        lanes[(_DRAWN + 1) * _LANES + j],
        lanes[(_DRAWN + 2) * _LANES + j],
        ball_noise if in_reach else player_noise,
        _BALL_SPEED if in_reach else _PLAYER_SPEED,
    )
    turned = angle + turn / (ONE + _FIVE * _length(player_vx, player_vy))
    lanes[AT.player_vx * _LANES + j] = pushed_x if is_dash else player_vx
    lanes[AT.player_vy * _LANES + j] = pushed_y if is_dash else player_vy
    lanes[AT.ball_vx * _LANES + j] = pushed_x if in_reach else ball_vx
    lanes[AT.ball_vy * _LANES + j] = pushed_y if in_reach else ball_vy
    lanes[AT.player_angle * _LANES + j] = turned if is_turn else angle


@inlined
def _keep(lanes: Any, j: Any, noise: Any) -> None:
    """Let the keepers move."""
    keeper_noise = noise * _PLAYER_NOISE
    keeper_x, keeper_y = lanes[AT.keeper_x * _LANES + j], lanes[AT.keeper_y * _LANES + j]
    ball_x, ball_y = lanes[AT.ball_x * _LANES + j], lanes[AT.ball_y * _LANES + j]
    roll_x, roll_y = _COASTED * lanes[AT.ball_vx * _LANES + j], _COASTED * lanes[AT.ball_vy * _LANES + j]
    end_x, end_y = ball_x + roll_x, ball_y + roll_y
    # The height at which the ball meets the goal line, times `roll_x`, which is positive if `end_x` is beyond it.
    height = ball_y * roll_x + roll_y * (_LENGTH - ball_x)
    is_shot = (end_x > _LENGTH) & (abs(height) <= _SAVED * roll_x) & (roll_x != ZERO) & (roll_y != ZERO)
    side = roll_x * (ball_y - keeper_y) - roll_y * (ball_x - keeper_x)
    across_x, across_y = -side * roll_y, side * roll_x
    after_x, after_y = end_x - keeper_x, end_y - keeper_y
    angle = atan2(across_y if is_shot else after_y, across_x if is_shot else after_x)
    keeper_vx, keeper_vy = _pushed(
        lanes[AT.keeper_vx * _LANES + j],
        lanes[AT.keeper_vy * _LANES + j],
        _SAVE if is_shot else _FOLLOW,
        angle,
        lanes[(_DRAWN + 3) * _LANES + j],
        lanes[(_DRAWN + 4) * _LANES + j],
        lanes[(_DRAWN + 5) * _LANES + j],
        keeper_noise,
        _PLAYER_SPEED,
    )
    lanes[AT.keeper_vx * _LANES + j], lanes[AT.keeper_vy * _LANES + j] = keeper_vx, keeper_vy
    lanes[AT.keeper_angle * _LANES + j] = angle


@inlined
def _roll(lanes: Any, j: Any, place: Any, velocity: Any, decay: Any) -> None:
    for axis in range(2):
        lanes[(place + axis) * _LANES + j] += lanes[(velocity + axis) * _LANES + j]
        lanes[(velocity + axis) * _LANES + j] *= decay


@inlined
def _overlap(lanes: Any, j: Any, one: Any, other: Any, touch: Any) -> Any:
    apart_x = lanes[one * _LANES + j] - lanes[other * _LANES + j]
    apart_y = lanes[(one + 1) * _LANES + j] - lanes[(other + 1) * _LANES + j]
    return _squared(apart_x, apart_y) < touch * touch


@inlined
def _collide(lanes: Any, j: Any, one: Any, other: Any, one_v: Any, other_v: Any, touch: Any) -> None:
    """Let two bodies bounce off each other where they overlap."""
    overlap = _overlap(lanes, j, one, other, touch)
    one_x, one_y = lanes[one * _LANES + j], lanes[(one + 1) * _LANES + j]
    other_x, other_y = lanes[other * _LANES + j], lanes[(other + 1) * _LANES + j]
    apart_x, apart_y = one_x - other_x, one_y - other_y
    distance = _length(apart_x, apart_y)
    fraction = HALF * (touch - distance) / max(distance, _TINY)
    push_x, push_y = apart_x * fraction, apart_y * fraction
    lanes[one * _LANES + j] = one_x + push_x if overlap else one_x
    lanes[(one + 1) * _LANES + j] = one_y + push_y if overlap else one_y
    lanes[other * _LANES + j] = other_x - push_x if overlap else other_x
    lanes[(other + 1) * _LANES + j] = other_y - push_y if overlap else other_y
    sign = -ONE if overlap else ONE
    for axis in range(2):
        lanes[(one_v + axis) * _LANES + j] *= sign
        lanes[(other_v + axis) * _LANES + j] *= sign


@inlined
def _end(lanes: Any, j: Any, is_kick: Any) -> Any:
    """Return the outcome after a tick: PLAYING where only the action is over, _GOING where it goes on."""
    x, y = lanes[AT.ball_x * _LANES + j], lanes[AT.ball_y * _LANES + j]
    to_keeper = _squared(lanes[AT.keeper_x * _LANES + j] - x, lanes[AT.keeper_y * _LANES + j] - y)
    to_player = _squared(lanes[AT.player_x * _LANES + j] - x, lanes[AT.player_y * _LANES + j] - y)
    speed = _squared(lanes[AT.ball_vx * _LANES + j], lanes[AT.ball_vy * _LANES + j])
    end = int32(rules.PLAYING) if is_kick & (speed <= _STILL_2) & (to_player <= _REACH_WITH_SLACK_2) else _GOING
    # Asked this way round, a position that is not finite ends the episode.
    is_inside = (x >= ZERO) & (x <= _LENGTH) & (abs(y) <= _HALF_WIDTH)
    end = end if is_inside else int32(rules.OUT)
    end = int32(rules.CAUGHT) if to_keeper < _CATCH_2 else end
    return int32(rules.GOAL) if (x >= _LENGTH) & (x <= _DEPTH) & (abs(y) <= _POST) else end


@part
def _tick(lanes: Any, numbers: Any, step: Any, noise: Any) -> Any:
    """Move the bodies in all lanes by one tick, and return how many of their actions are over."""
    num_touching = int32(0)
    for j in range(_LANES):
        _draw(lanes, numbers, j, step)
        _play(lanes, j, noise)
        _keep(lanes, j, noise)
        _roll(lanes, j, AT.player_x, AT.player_vx, _PLAYER_DECAY)
        _roll(lanes, j, AT.keeper_x, AT.keeper_vx, _PLAYER_DECAY)
        _roll(lanes, j, AT.ball_x, AT.ball_vx, _BALL_DECAY)
        touch = _overlap(lanes, j, AT.player_x, AT.keeper_x, _PLAYERS)
        touch |= _overlap(lanes, j, AT.player_x, AT.ball_x, _PLAYER_BALL)
        touch |= _overlap(lanes, j, AT.keeper_x, AT.ball_x, _KEEPER_BALL)
        num_touching = int32(num_touching + int32(touch & (numbers[_ROW * _LANES + j] >= 0)))
    if num_touching > 0:  # this changes nothing in the other lanes
        for j in range(_LANES):
            _collide(lanes, j, AT.player_x, AT.keeper_x, AT.player_vx, AT.keeper_vx, _PLAYERS)
            _collide(lanes, j, AT.player_x, AT.ball_x, AT.player_vx, AT.ball_vx, _PLAYER_BALL)
            _collide(lanes, j, AT.keeper_x, AT.ball_x, AT.keeper_vx, AT.ball_vx, _KEEPER_BALL)
    num_over = int32(0)
    for j in range(_LANES):
        end = _end(lanes, j, numbers[_IS_KICK * _LANES + j] != 0)
        numbers[_END * _LANES + j] = end
        num_over = int32(num_over + int32((end != _GOING) & (numbers[_ROW * _LANES + j] >= 0)))
    return num_over


@part
def _aim(action: Any, first: Any, second: Any, settings: Any) -> Any:
    """Return the point that an action aims at."""
    if settings[IS_HARD] != 0.0:
        stretches = _REPAIRED if settings[HAS_MIDDLE] != 0.0 else _STRETCHES
        stretch = max(action - 1, 0) % len(stretches)
        low, high = stretches[stretch, 0], stretches[stretch, 1]
        shot = _FLOAT32_GOAL * (HALF * (low + high) - first * (HALF * (high - low)))
        kick_x, kick_y = _LENGTH * (first + ONE), _HALF_WIDTH * second
    else:
        shot, kick_x, kick_y = first, first, second
    if action != rules.KICK_TO:
        return _SHOT_X, _clip(shot, _POST)
    kick_x = min(max(kick_x, ZERO), TWO * _LENGTH)
    return kick_x, _clip(kick_y, _HALF_WIDTH) if settings[KICKS_TO_POINT] != 0.0 else kick_x


@part
def _goal_distance(body: Any, is_repaired: Any) -> Any:
    beside, depth = abs(body[AT.ball_y]) - _POST, _LENGTH - body[AT.ball_x]
    if depth > ZERO:
        return _length(depth, beside) if beside > ZERO else depth
    if not is_repaired and body[AT.ball_y] < -_POST:
        return _POST - body[AT.ball_y]
    return max(beside, ZERO)


@part
def _start(floats: Any, row: Any, bits: Any, step: Any) -> None:
    """Put everyone where an episode begins."""
    y = _HALF_WIDTH * (TWO * kernels.uniform(bits, step, 0) - ONE)
    angle = math.atan2(-y, _LENGTH)
    ball_x, ball_y = _REACH * math.cos(angle), y + _REACH * math.sin(angle)
    keeper_y = ball_y * (_LENGTH - _KEEPER_START) / (_LENGTH - ball_x)
    floats[:, row] = ZERO
    floats[AT.player_y, row], floats[AT.player_angle, row] = y, angle
    floats[AT.ball_x, row], floats[AT.ball_y, row] = ball_x, ball_y
    floats[AT.keeper_x, row], floats[AT.keeper_y, row] = _KEEPER_START, keeper_y
    floats[AT.keeper_angle, row] = math.atan2(ball_y - keeper_y, ball_x - _KEEPER_START)


@part
def _observe(body: Any, settings: Any, observation: Any) -> None:
    """Write what is observed of a row."""
    across, along = body[AT.ball_y] - body[AT.keeper_y], body[AT.ball_x] - body[AT.keeper_x]
    distance = max(_length(along, across), _TINY)
    top = _POST if settings[REPAIRS_PROJECTION] != 0.0 else TWO * _POST
    if along == ZERO:
        shadow = -_POST if across > ZERO else _POST
    else:
        shadow = min(max(body[AT.ball_y] + across / along * (_LENGTH - body[AT.ball_x]), -_POST), top)
    observation[0], observation[1] = body[AT.player_x], body[AT.player_y]
    observation[2], observation[3], observation[4] = body[AT.player_vx], body[AT.player_vy], body[AT.player_angle]
    observation[5], observation[6] = body[AT.keeper_x], body[AT.keeper_y]
    observation[7], observation[8], observation[9] = body[AT.keeper_vx], body[AT.keeper_vy], body[AT.keeper_angle]
    observation[10], observation[11] = body[AT.ball_x], body[AT.ball_y]
    observation[12], observation[13] = body[AT.ball_vx], body[AT.ball_vy]
    observation[14], observation[15], observation[16] = along / distance, across / distance, shadow
    if settings[IS_SCALED] != 0.0:
        for i in range(17):
            observation[i] = TWO * (observation[i] - _LOW[i]) / (_HIGH[i] - _LOW[i]) - ONE


@part
def _begin(integers: Any, discrete: Any, parameters: Any, mask: Any, settings: Any, aims: Any) -> Any:
    """Count the steps of the rows that act, write where they aim, `[2, N]`, and return those whose action is played."""
    rows = np.empty(len(mask), np.int64)
    num_rows = 0
    for row in range(len(mask)):
        if mask[row] and integers[OUTCOME_ROW, row] == rules.PLAYING:
            integers[STEPS_ROW, row] += 1
            if integers[STEPS_ROW, row] < settings[kernels.MAX_STEPS]:
                action = discrete[row]
                first = kernels.parameter(parameters, row, 0, action)
                second = kernels.parameter(parameters, row, 1, action)
                aims[0, row], aims[1, row] = _aim(action, first, second, settings)
                rows[num_rows] = row
                num_rows += 1
            else:  # the last action is not played
                integers[OUTCOME_ROW, row] = rules.TIME_LIMIT
    return rows[:num_rows]


@part
def _act(floats: Any, integers: Any, discrete: Any, rows: Any, aims: Any, settings: Any) -> None:
    """Play the actions of these rows, int64 `[M]`."""
    lanes = np.zeros(_NUM_FLOATS * _LANES, np.float32)
    numbers = np.full(_NUM_INTEGERS * _LANES, -1, np.int32)
    noise = _F(settings[NOISE])
    step = kernels.stream_step(int32(settings[kernels.NOISE_STREAM]))
    num_started, num_ended, num_rows = 0, 0, len(rows)
    while True:
        for j in range(_LANES):
            row = numbers[_ROW * _LANES + j]
            if row >= 0:
                if numbers[_END * _LANES + j] == _GOING:
                    continue
                for column in range(_NUM_COLUMNS):
                    floats[column, row] = lanes[column * _LANES + j]
                integers[OUTCOME_ROW, row] = numbers[_END * _LANES + j]
                numbers[_ROW * _LANES + j] = -1
                num_ended += 1
            if num_started < num_rows:
                row = rows[num_started]
                num_started += 1
                numbers[_ROW * _LANES + j] = row
                for column in range(_NUM_COLUMNS):
                    lanes[column * _LANES + j] = floats[column, row]
                lanes[_AIM_X * _LANES + j], lanes[_AIM_Y * _LANES + j] = aims[0, row], aims[1, row]
                numbers[_IS_KICK * _LANES + j] = discrete[row] == rules.KICK_TO
                bits, _ = kernels.noise_rng(settings, row, integers[EPISODE_ROW, row])
                numbers[_BITS * _LANES + j] = int32(bits)
                numbers[_INDEX * _LANES + j] = (integers[STEPS_ROW, row] - 1) * rules._NUMBERS_PER_ACTION
        if num_ended == num_rows:
            return
        while _tick(lanes, numbers, step, noise) == 0:
            pass


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
    before = integers[OUTCOME_ROW].copy()
    if mode != kernels.RESTART:
        aims = np.empty((2, len(mask)), np.float32)
        rows = _begin(integers, discrete, parameters, mask, settings, aims)
        _act(floats, integers, discrete, rows, aims, settings)
    body = np.empty(_NUM_COLUMNS, np.float32)
    for row in range(len(mask)):
        was_over = before[row] != rules.PLAYING
        end = integers[OUTCOME_ROW, row]
        body[:] = floats[:, row]
        if end != rules.PLAYING and not was_over:
            is_repaired = settings[REPAIRS_DISTANCE] != 0.0
            rewards[row] = _GOAL_REWARD if end == rules.GOAL else -_goal_distance(body, is_repaired)
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                bits, step = kernels.new_episode(integers, row, settings)
                _start(floats, row, bits, step)
                body[:] = floats[:, row]
            _observe(body, settings, observations[reading, row])
            kernels.report(integers[OUTCOME_ROW, row], len(rules.OUTCOMES), row, outcomes[reading], flags[reading])
    return -1
