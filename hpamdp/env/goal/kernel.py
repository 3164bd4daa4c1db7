"""The rules of Goal and Hard Goal for one row, and the loop over all rows that Numba compiles.

It states what `rules` says of columns, for the CPU alone; a test compares the two. An action's ticks are a loop of its
row, so that no row waits for another's.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hpamdp.env import kernels
from hpamdp.env.goal import rules
from hpamdp.env.kernels import EPISODE_ROW, HALF, ONE, OUTCOME_ROW, STEPS_ROW, TURN, TWO, ZERO, inlined, kernel, part

# The problem's own settings.
NOISE, IS_SCALED, KICKS_TO_POINT, REPAIRS_DISTANCE, REPAIRS_PROJECTION, HAS_MIDDLE, IS_HARD = range(
    kernels.OWN, kernels.OWN + 7
)

# Rows of the state, and of a row's bodies while its action lasts.
(
    _PLAYER_X,
    _PLAYER_Y,
    _KEEPER_X,
    _KEEPER_Y,
    _BALL_X,
    _BALL_Y,
    _PLAYER_VX,
    _PLAYER_VY,
    _KEEPER_VX,
    _KEEPER_VY,
    _BALL_VX,
    _BALL_VY,
    _PLAYER_ANGLE,
    _KEEPER_ANGLE,
) = range(14)
_GOING = -1  # the end of an action that is not over

_F = np.float32
_LENGTH, _HALF_WIDTH, _POST = _F(rules.LENGTH), _F(rules.HALF_WIDTH), _F(rules.GOAL_HALF_WIDTH)
_DEPTH = _F(rules.LENGTH + rules.GOAL_DEPTH)
_REACH, _REACH_WITH_SLACK = _F(rules.REACH), _F(rules.REACH + rules._REACH_SLACK)
_COAST, _STILL, _CATCH = _F(rules._COAST), _F(rules._STILL), _F(rules.CATCH)
_DASH, _SAVE, _FOLLOW = _F(rules._DASH), _F(rules._SAVE), _F(rules._FOLLOW)
_PLAYER_NOISE, _BALL_NOISE = _F(rules._PLAYER_NOISE), _F(rules._BALL_NOISE)
_PLAYER_SPEED, _BALL_SPEED = _F(rules._PLAYER_SPEED), _F(rules._BALL_SPEED)
_PLAYER_DECAY, _BALL_DECAY = _F(rules._PLAYER_DECAY), _F(rules._BALL_DECAY)
_KICK = _F(rules._MAX_POWER * rules._BALL_RATE)
_FACING, _KEEPER_START = _F(rules._FACING), _F(rules._KEEPER_START)
_OFF_SHARE, _FAR_SHARE = _F(0.25 / math.pi), _F(0.25 / rules.REACH)
_SAVED = _F(rules.GOAL_HALF_WIDTH + rules._KEEPER_MARGIN)
_AIM_X = _F(rules.LENGTH + rules._SHOT_DEPTH)
_PLAYERS, _PLAYER_BALL = _F(rules.PLAYER_SIZE + rules.KEEPER_SIZE), _F(rules.PLAYER_SIZE + rules.BALL_SIZE)
_KEEPER_BALL = _F(rules.KEEPER_SIZE + rules.BALL_SIZE)
_FIVE, _TINY = _F(5.0), _F(1e-12)
_GOAL_REWARD = _F(rules.GOAL_REWARD)
_FLOAT32_GOAL = _F(rules._FLOAT32_GOAL)
_LOW, _HIGH = np.array(rules.OBSERVATION_LOW, np.float32), np.array(rules.OBSERVATION_HIGH, np.float32)
_STRETCHES = np.array(rules.STRETCHES, np.float32)
_REPAIRED = np.array([*rules.STRETCHES[:2], rules.REPAIRED_MIDDLE, *rules.STRETCHES[3:]], np.float32)


@inlined
def _length(x: Any, y: Any) -> Any:
    return math.sqrt(x * x + y * y)


@inlined
def _clip(value: Any, limit: Any) -> Any:
    return min(max(value, -limit), limit)


@part
def _push(body: Any, at: Any, effort: Any, angle: Any, drawn: Any, first: Any, noise: Any, limit: Any) -> None:
    """Change the velocity at `at` of the bodies: `rules._accelerate`."""
    angle = angle + angle * noise * drawn[first]
    jolt = noise * _length(body[at], body[at + 1])
    push_x = _clip(effort * math.cos(angle) + jolt * drawn[first + 1], limit)
    push_y = _clip(effort * math.sin(angle) + jolt * drawn[first + 2], limit)
    body[at] = _clip(body[at] + push_x, limit)
    body[at + 1] = _clip(body[at + 1] + push_y, limit)


@part
def _play(body: Any, aim_x: Any, aim_y: Any, drawn: Any, noise: Any) -> None:
    """Let the player move: `rules._play`."""
    to_x, to_y = body[_BALL_X] - body[_PLAYER_X], body[_BALL_Y] - body[_PLAYER_Y]
    distance = _length(to_x, to_y)
    angle = body[_PLAYER_ANGLE]
    turn = math.atan2(to_y, to_x) - angle
    turn -= TURN * _F(np.rint(turn / TURN))
    off = abs(turn)
    if distance <= _REACH_WITH_SLACK:
        wish_x = _COAST * (aim_x - body[_PLAYER_X]) - body[_BALL_VX]
        wish_y = _COAST * (aim_y - body[_PLAYER_Y]) - body[_BALL_VY]
        share = ONE - _OFF_SHARE * off - _FAR_SHARE * distance
        kick = min(_length(wish_x, wish_y), _KICK * share)
        _push(body, _BALL_VX, kick, math.atan2(wish_y, wish_x), drawn, 0, noise * _BALL_NOISE, _BALL_SPEED)
    elif off < _FACING:
        _push(body, _PLAYER_VX, _DASH, angle, drawn, 0, noise * _PLAYER_NOISE, _PLAYER_SPEED)
    else:
        body[_PLAYER_ANGLE] = angle + turn / (ONE + _FIVE * _length(body[_PLAYER_VX], body[_PLAYER_VY]))


@part
def _keep(body: Any, drawn: Any, noise: Any) -> None:
    """Let the keeper move: `rules._keep`."""
    roll_x, roll_y = body[_BALL_VX] / _COAST, body[_BALL_VY] / _COAST
    end_x, end_y = body[_BALL_X] + roll_x, body[_BALL_Y] + roll_y
    slope = ZERO if roll_x == ZERO else roll_y / roll_x
    height = body[_BALL_Y] + slope * (_LENGTH - body[_BALL_X])
    if (end_x > _LENGTH) & (abs(height) <= _SAVED) & (slope != ZERO):
        side = roll_x * (body[_BALL_Y] - body[_KEEPER_Y]) - roll_y * (body[_BALL_X] - body[_KEEPER_X])
        angle = math.atan2(side * roll_x, -side * roll_y)
        effort = _SAVE
    else:
        angle = math.atan2(end_y - body[_KEEPER_Y], end_x - body[_KEEPER_X])
        effort = _FOLLOW
    _push(body, _KEEPER_VX, effort, angle, drawn, 3, noise * _PLAYER_NOISE, _PLAYER_SPEED)
    body[_KEEPER_ANGLE] = angle


@inlined
def _roll(body: Any, place: Any, velocity: Any, decay: Any) -> None:
    for axis in range(2):
        body[place + axis] += body[velocity + axis]
        body[velocity + axis] *= decay


@inlined
def _collide(body: Any, one: Any, other: Any, one_v: Any, other_v: Any, touch: Any) -> None:
    """Let two bodies bounce off each other, if they overlap: `rules._collide`."""
    apart_x, apart_y = body[one] - body[other], body[one + 1] - body[other + 1]
    distance = _length(apart_x, apart_y)
    if distance < touch:
        share = HALF * (touch - distance) / max(distance, _TINY)
        body[one] += apart_x * share
        body[one + 1] += apart_y * share
        body[other] -= apart_x * share
        body[other + 1] -= apart_y * share
        for axis in range(2):
            body[one_v + axis] = -body[one_v + axis]
            body[other_v + axis] = -body[other_v + axis]


@part
def _tick(body: Any, aim_x: Any, aim_y: Any, drawn: Any, noise: Any) -> None:
    """Move the bodies of a row by one tick: `rules.tick`."""
    _play(body, aim_x, aim_y, drawn, noise)
    _keep(body, drawn, noise)
    _roll(body, _PLAYER_X, _PLAYER_VX, _PLAYER_DECAY)
    _roll(body, _KEEPER_X, _KEEPER_VX, _PLAYER_DECAY)
    _roll(body, _BALL_X, _BALL_VX, _BALL_DECAY)
    _collide(body, _PLAYER_X, _KEEPER_X, _PLAYER_VX, _KEEPER_VX, _PLAYERS)
    _collide(body, _PLAYER_X, _BALL_X, _PLAYER_VX, _BALL_VX, _PLAYER_BALL)
    _collide(body, _KEEPER_X, _BALL_X, _KEEPER_VX, _BALL_VX, _KEEPER_BALL)


@part
def _end(body: Any, is_kick: Any) -> Any:
    """Return the outcome after a tick: PLAYING where only the action is over, _GOING where it goes on."""
    x, y = body[_BALL_X], body[_BALL_Y]
    if (x >= _LENGTH) & (x <= _DEPTH) & (abs(y) <= _POST):
        return rules.GOAL
    if _length(body[_KEEPER_X] - x, body[_KEEPER_Y] - y) < _CATCH:
        return rules.CAUGHT
    if not ((x >= ZERO) & (x <= _LENGTH) & (abs(y) <= _HALF_WIDTH)):
        return rules.OUT
    is_still = _length(body[_BALL_VX], body[_BALL_VY]) <= _STILL
    in_reach = _length(body[_PLAYER_X] - x, body[_PLAYER_Y] - y) <= _REACH_WITH_SLACK
    return rules.PLAYING if is_kick & is_still & in_reach else _GOING


@part
def _aim(action: Any, first: Any, second: Any, settings: Any) -> Any:
    """Return the point that an action aims at: `rules.goal_aim` and `hard_goal_aim`."""
    if settings[IS_HARD] != 0.0:
        stretches = _REPAIRED if settings[HAS_MIDDLE] != 0.0 else _STRETCHES
        stretch = max(action - 1, 0) % len(stretches)
        low, high = stretches[stretch, 0], stretches[stretch, 1]
        shot = _FLOAT32_GOAL * (HALF * (low + high) - first * (HALF * (high - low)))
        kick_x, kick_y = _LENGTH * (first + ONE), _HALF_WIDTH * second
    else:
        shot, kick_x, kick_y = first, first, second
    if action != rules.KICK_TO:
        return _AIM_X, _clip(shot, _POST)
    kick_x = min(max(kick_x, ZERO), TWO * _LENGTH)
    return kick_x, _clip(kick_y, _HALF_WIDTH) if settings[KICKS_TO_POINT] != 0.0 else kick_x


@part
def _goal_distance(body: Any, is_repaired: Any) -> Any:
    beside, depth = abs(body[_BALL_Y]) - _POST, _LENGTH - body[_BALL_X]
    if depth > ZERO:
        return _length(depth, beside) if beside > ZERO else depth
    if not is_repaired and body[_BALL_Y] < -_POST:
        return _POST - body[_BALL_Y]
    return max(beside, ZERO)


@part
def _start(floats: Any, row: Any, bits: Any, step: Any) -> None:
    """Put everyone where an episode begins: `rules.start`."""
    y = _HALF_WIDTH * (TWO * kernels.uniform(bits, step, 0) - ONE)
    angle = math.atan2(-y, _LENGTH)
    ball_x, ball_y = _REACH * math.cos(angle), y + _REACH * math.sin(angle)
    keeper_y = ball_y * (_LENGTH - _KEEPER_START) / (_LENGTH - ball_x)
    floats[:, row] = ZERO
    floats[_PLAYER_Y, row], floats[_PLAYER_ANGLE, row] = y, angle
    floats[_BALL_X, row], floats[_BALL_Y, row] = ball_x, ball_y
    floats[_KEEPER_X, row], floats[_KEEPER_Y, row] = _KEEPER_START, keeper_y
    floats[_KEEPER_ANGLE, row] = math.atan2(ball_y - keeper_y, ball_x - _KEEPER_START)


@part
def _observe(body: Any, settings: Any, observation: Any) -> None:
    """Write what is observed of a row: `rules.observe`."""
    across, along = body[_BALL_Y] - body[_KEEPER_Y], body[_BALL_X] - body[_KEEPER_X]
    distance = max(_length(along, across), _TINY)
    top = _POST if settings[REPAIRS_PROJECTION] != 0.0 else TWO * _POST
    if along == ZERO:
        shadow = -_POST if across > ZERO else _POST
    else:
        shadow = min(max(body[_BALL_Y] + across / along * (_LENGTH - body[_BALL_X]), -_POST), top)
    observation[0], observation[1] = body[_PLAYER_X], body[_PLAYER_Y]
    observation[2], observation[3], observation[4] = body[_PLAYER_VX], body[_PLAYER_VY], body[_PLAYER_ANGLE]
    observation[5], observation[6] = body[_KEEPER_X], body[_KEEPER_Y]
    observation[7], observation[8], observation[9] = body[_KEEPER_VX], body[_KEEPER_VY], body[_KEEPER_ANGLE]
    observation[10], observation[11] = body[_BALL_X], body[_BALL_Y]
    observation[12], observation[13] = body[_BALL_VX], body[_BALL_VY]
    observation[14], observation[15], observation[16] = along / distance, across / distance, shadow
    if settings[IS_SCALED] != 0.0:
        for i in range(17):
            observation[i] = TWO * (observation[i] - _LOW[i]) / (_HIGH[i] - _LOW[i]) - ONE


@part
def _act(body: Any, steps: Any, aim_x: Any, aim_y: Any, is_kick: Any, bits: Any, step: Any, noise: Any) -> Any:
    """Play the ticks of an action and return its end."""
    drawn = np.empty(rules.NUMBERS_PER_TICK, np.float32)
    index = steps * rules._NUMBERS_PER_ACTION
    end = _GOING
    while end == _GOING:
        for place in range(rules.NUMBERS_PER_TICK):
            drawn[place] = TWO * kernels.uniform(bits, step, index + place) - ONE
        index += rules.NUMBERS_PER_TICK
        _tick(body, aim_x, aim_y, drawn, noise)
        end = _end(body, is_kick)
    return end


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
    noise = _F(settings[NOISE])
    body = np.empty(14, np.float32)
    for row in range(len(mask)):
        was_over = integers[OUTCOME_ROW, row] != rules.PLAYING
        body[:] = floats[:, row]
        if mode != kernels.RESTART and mask[row] and not was_over:
            steps = integers[STEPS_ROW, row]
            integers[STEPS_ROW, row] = steps + 1
            end = rules.TIME_LIMIT  # the last action is not played
            if steps + 1 < settings[kernels.MAX_STEPS]:
                action = discrete[row]
                first = kernels.parameter(parameters, row, 0, action, places, bounds)
                second = kernels.parameter(parameters, row, 1, action, places, bounds)
                aim_x, aim_y = _aim(action, first, second, settings)
                bits, step = kernels.noise_key(settings, row, integers[EPISODE_ROW, row])
                end = _act(body, steps, aim_x, aim_y, action == rules.KICK_TO, bits, step, noise)
                floats[:, row] = body
            integers[OUTCOME_ROW, row] = end
            if end == rules.GOAL:
                rewards[row] = _GOAL_REWARD
            elif end != rules.PLAYING:
                rewards[row] = -_goal_distance(body, settings[REPAIRS_DISTANCE] != 0.0)
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                bits, step = kernels.new_episode(integers, row, settings)
                _start(floats, row, bits, step)
                body[:] = floats[:, row]
            _observe(body, settings, observations[reading, row])
            kernels.report(integers[OUTCOME_ROW, row], len(rules.OUTCOMES), row, outcomes[reading], flags[reading])
    return -1
