"""The rules of Catch Point for one row, and the loop over all rows that Numba compiles.

A test compares it with the tensor functions in experiments/domains/published_rules.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from hpamdp.env import kernels, point_kernel
from hpamdp.env.catch_point import rules
from hpamdp.env.catch_point.options import PUBLISHED_CATCHES
from hpamdp.env.kernels import ONE, OUTCOME_ROW, STEPS_ROW, ZERO, kernel, part, sin_cos

CATCHES, LATE_END, PROGRESS = range(kernels.OWN, kernels.OWN + 3)  # the problem's own settings

_MISSES = 0  # the first row of the integers

_F = np.float32
_FORCE, _PI, _SIX, _TWELVE = _F(rules._FORCE), _F(math.pi), _F(6.0), _F(12.0)


@part
def _act(floats: Any, integers: Any, row: Any, action: Any, given: Any, settings: Any) -> Any:
    """Take an action in a row and return its outcome and reward."""
    is_catch = action == rules.CATCH
    force = ZERO if is_catch else _FORCE
    sin, cos = sin_cos(_PI * given)
    squared = point_kernel.move(floats, row, force * sin, force * cos)
    misses = integers[_MISSES, row]
    has_catches = misses < settings[CATCHES]
    is_hit = is_catch & has_catches & (squared <= point_kernel.HIT)
    if is_catch and has_catches and not is_hit:
        misses += 1
    integers[_MISSES, row] = misses
    reward = (point_kernel.HIT_REWARD if is_hit else ZERO) - squared if has_catches else ZERO
    is_lost = not has_catches if settings[LATE_END] != 0.0 else misses >= settings[CATCHES]
    return rules.CAUGHT if is_hit else (rules.NO_CATCHES_LEFT if is_lost else rules.GOING_ON), reward


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
    for row in range(len(mask)):
        was_over = integers[OUTCOME_ROW, row] != rules.GOING_ON
        if mode != kernels.RESTART and mask[row] and not was_over:
            action = discrete[row]
            given = kernels.parameter(parameters, row, 0, action)
            outcome, rewards[row] = _act(floats, integers, row, action, given, settings)
            kernels.end_step(integers, row, outcome, len(rules.OUTCOMES), settings)
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                bits, step = kernels.new_episode(integers, row, settings)
                integers[_MISSES, row] = 0
                point_kernel.start(floats, row, bits, step)
            point_kernel.observe(floats, row, observations[reading, row])
            if settings[PROGRESS] != 0.0:
                misses = min(integers[_MISSES, row], PUBLISHED_CATCHES)
                observations[reading, row, 4] = _F(misses) / _SIX - ONE
                observations[reading, row, 5] = _F(integers[STEPS_ROW, row]) / _TWELVE - ONE
            kernels.report(integers[OUTCOME_ROW, row], len(rules.OUTCOMES), row, outcomes[reading], flags[reading])
    return -1
