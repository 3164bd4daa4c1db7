"""The rules of Office for one row, and the loop over all rows that Numba compiles.

`rules` states a move for columns, too, because the player that knows the map plans with it. A test compares the two.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hpamdp.env import kernels
from hpamdp.env.kernels import (
    EPISODE_ROW,
    NUM_OPTIONS,
    ONE,
    OUTCOME_ROW,
    STEPS_ROW,
    TWO,
    ZERO,
    inlined,
    kernel,
    part,
)
from hpamdp.env.office import rules
from hpamdp.env.tiles import write_tiles

SLIP, TILES = range(kernels.OWN, kernels.OWN + 2)  # the problem's own settings

_X, _Y = range(2)  # the first rows of the floats
_COFFEE, _MAIL = range(2)  # the first rows of the integers
_ANY = -1  # in place of a goal: the agent takes whatever it reaches

_F = np.float32
_START_X, _START_Y = _F(rules.START[0]), _F(rules.START[1])
_PLACES, _WALLS = np.array(rules.PLACES, np.float32), np.array(rules.WALLS, np.float32)
_REACH = _F(rules.REACH)
_STEP, _REFUSED, _TAKEN = _F(rules.STEP_REWARD), _F(rules.REFUSED_REWARD), _F(rules.TAKEN_REWARD)
_DELIVERED = _F(rules.DELIVERED_REWARD)
_NUM_PLAIN = len(rules.OBSERVATION_NAMES)


@part
def _is_refused(x: Any, y: Any, to_x: Any, to_y: Any) -> Any:
    """Return whether a move along an axis touches a wall or leaves [0, 1): `rules.is_refused`."""
    left, right = min(x, to_x), max(x, to_x)
    top, bottom = min(y, to_y), max(y, to_y)
    refused = (left < ZERO) | (right >= ONE) | (top < ZERO) | (bottom >= ONE)
    for wall in range(len(_WALLS)):
        is_level = (right >= _WALLS[wall, 0]) & (left <= _WALLS[wall, 1])
        refused |= is_level & (bottom >= _WALLS[wall, 2]) & (top <= _WALLS[wall, 3])
    return refused


@inlined
def _is_near(x: Any, y: Any, goal: Any) -> Any:
    """Return whether a position is within reach of a goal: `rules.is_near`."""
    return (abs(x - _PLACES[goal, 0]) <= _REACH) & (abs(y - _PLACES[goal, 1]) <= _REACH)


@inlined
def _goal_in_mind(has_coffee: Any, has_mail: Any, option: Any) -> Any:
    """Return the goal that an agent goes for: `rules.goal_in_mind`."""
    if has_coffee and has_mail:
        return rules.TARGET
    if has_coffee or (option == rules.MAIL and not has_mail):
        return rules.MAIL
    return rules.COFFEE


@part
def _act(floats: Any, integers: Any, row: Any, action: Any, length: Any, slips: Any, goal: Any) -> Any:
    """Take an action in a row and return its outcome and reward: `rules.act`."""
    x, y = floats[_X, row], floats[_Y, row]
    to_x, to_y = x, y
    if (action <= rules.DOWN) ^ slips:
        to_y += length
    else:
        to_x += length
    if _is_refused(x, y, to_x, to_y):
        return rules.ON_THE_WAY, _REFUSED
    floats[_X, row], floats[_Y, row] = to_x, to_y
    has_coffee, has_mail = integers[_COFFEE, row] != 0, integers[_MAIL, row] != 0
    if not has_coffee and goal in (_ANY, rules.COFFEE) and _is_near(to_x, to_y, rules.COFFEE):
        integers[_COFFEE, row] = 1
        return rules.ON_THE_WAY, _TAKEN
    if not has_mail and goal in (_ANY, rules.MAIL) and _is_near(to_x, to_y, rules.MAIL):
        integers[_MAIL, row] = 1
        return rules.ON_THE_WAY, _TAKEN
    if has_coffee and has_mail and _is_near(to_x, to_y, rules.TARGET):
        return rules.DELIVERED, _DELIVERED
    return rules.ON_THE_WAY, _STEP


@part
def _observe(floats: Any, integers: Any, row: Any, tiles: Any, observation: Any) -> None:
    """Write what is observed of a row."""
    x, y = floats[_X, row], floats[_Y, row]
    observation[0], observation[1] = TWO * y - ONE, TWO * x - ONE
    observation[2] = TWO * _F(integers[_COFFEE, row]) - ONE
    observation[3] = TWO * _F(integers[_MAIL, row]) - ONE
    write_tiles(x, y, tiles, observation, _NUM_PLAIN)


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
    slip = _F(settings[SLIP])
    has_goal, tiles = settings[NUM_OPTIONS] > 0, int(settings[TILES])
    for row in range(len(mask)):
        was_over = integers[OUTCOME_ROW, row] != rules.ON_THE_WAY
        if mode != kernels.RESTART and mask[row] and not was_over:
            action = discrete[row]
            length = kernels.parameter(parameters, row, 0, action)
            bits, step = kernels.noise_rng(settings, row, integers[EPISODE_ROW, row])
            slips = kernels.uniform(bits, step, integers[STEPS_ROW, row]) < slip
            goal = _ANY
            if has_goal:
                goal = _goal_in_mind(integers[_COFFEE, row] != 0, integers[_MAIL, row] != 0, option[row])
            outcome, rewards[row] = _act(floats, integers, row, action, length, slips, goal)
            kernels.end_step(integers, row, outcome, len(rules.OUTCOMES), settings)
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                kernels.new_episode(integers, row, settings)
                floats[_X, row], floats[_Y, row] = _START_X, _START_Y
                integers[_COFFEE, row], integers[_MAIL, row] = 0, 0
            _observe(floats, integers, row, tiles, observations[reading, row])
            kernels.report(integers[OUTCOME_ROW, row], len(rules.OUTCOMES), row, outcomes[reading], flags[reading])
    return -1
