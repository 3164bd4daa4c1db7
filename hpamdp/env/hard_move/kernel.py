"""The rules of Hard Move for one row, and the loop over all rows that Numba compiles.

A test compares it with the tensor functions in experiments/domains/published_rules.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hpamdp.env import kernels, point_kernel
from hpamdp.env.hard_move import rules
from hpamdp.env.kernels import OUTCOME_ROW, ZERO, kernel

MOTIONS = kernels.OWN  # from here on the settings are the motions of the sets, x and y in turn

_F = np.float32
_FORCE = _F(rules._FORCE)


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
            push = _FORCE * given
            motion_x, motion_y = _F(settings[MOTIONS + 2 * action]), _F(settings[MOTIONS + 2 * action + 1])
            squared = point_kernel.move(floats, row, push * motion_x, push * motion_y)
            is_hit = squared <= point_kernel.HIT
            rewards[row] = (point_kernel.HIT_REWARD if is_hit else ZERO) - squared
            outcome = rules.REACHED if is_hit else rules.GOING_ON
            kernels.end_step(integers, row, outcome, len(rules.OUTCOMES), settings)
        for reading in range(len(observations)):
            if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                bits, step = kernels.new_episode(integers, row, settings)
                point_kernel.start(floats, row, bits, step)
            point_kernel.observe(floats, row, observations[reading, row])
            kernels.report(integers[OUTCOME_ROW, row], len(rules.OUTCOMES), row, outcomes[reading], flags[reading])
    return -1
