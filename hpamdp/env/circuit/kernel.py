"""The rules of circuit design for one row, and the loop over all rows that Numba compiles.

A gate changes the amplitudes in pairs, by the bits of their indices.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from hpamdp.env import kernels
from hpamdp.env.circuit import gates, rules
from hpamdp.env.circuit.rules import Design
from hpamdp.env.kernels import EPISODE_ROW, HALF, ONE, OUTCOME_ROW, STEPS_ROW, TWO, ZERO, kernel, part
from hpamdp.env.rng_streams import TRAINING

# The problem's own settings: the sizes, what is rewarded and observed, whether targets are random; then the gates of
# all sets, NUM_OF_GATE numbers each, the fixed target, and the circuits that training begins with.
WIRES, DEPTH, COLUMNS, IS_NATIVE, REWARD, OBSERVES_DEPTH, IS_RANDOM, NUM_BEGINNINGS = range(
    kernels.OWN, kernels.OWN + 8
)
FLOOR, BEGIN_EPISODES, BEGIN_GATES, NUM_GATES, NUM_SETS, OWN_GATES = range(kernels.OWN + 8, kernels.OWN + 14)
NUM_OF_GATE = 6
_KIND, _FLIPPED, _CONTROL, _HAS_ANGLE, _ANGLE, _COST = range(NUM_OF_GATE)
_GATE_SET_ROW, _GATE_ROW = -5, -4
_MOST_ROWS = 8  # of an operator
# Rows that are copied at once, so that the entries of each lie side by side: they fill a cache line of a column.
_SIDE_BY_SIDE = 16

_F = np.float32
_PI, _MATCH = _F(math.pi), _F(rules.MATCH)
_PROGRESS, _GAIN = rules.REWARDS.index("progress"), rules.REWARDS.index("gain")
_STOP, _PHASE, _MIX, _FLIP = gates.STOP, gates.PHASE, gates.MIX, gates.FLIP


def settings_of(design: Design) -> Sequence[float]:
    """Return the design in numbers."""
    task = design.task
    sizes = [task.n, task.depth, design.num_columns]
    flags = [design.is_native, rules.REWARDS.index(design.reward), design.observes_depth, design.target is None]
    circuits, depths = design.beginnings or ([], [])
    floor = math.nan if design.floor is None else design.floor
    sets = [len(design.gate_sets[0]), len(design.gate_sets)]
    begin = [design.begin_episodes, design.begin_gates]
    numbers: list[float] = [*sizes, *flags, len(circuits), floor, *begin, *sets]
    for gate in (gate for gate_set in design.gate_sets for gate in gate_set):
        angle = 0.0 if gate.angle is None else gate.angle
        numbers += [gate.kind, gate.flipped, gate.control, gate.angle is None, angle, gate.cost]
    if design.target is not None:
        numbers += torch.view_as_real(design.target.flatten()).T.flatten().tolist()
    for circuit, of_wires in zip(circuits, depths, strict=True):
        numbers += [*torch.view_as_real(circuit.flatten()).T.flatten().tolist(), *of_wires.tolist()]
    return numbers


@part
def _apply(entries: Any, kind: Any, flipped: Any, control: Any, angle: Any, num_rows: Any, num_columns: Any) -> None:
    """Apply a gate to a circuit in place: `gates.Gate`."""
    imaginary = num_rows * num_columns
    if kind == _PHASE:
        mask = flipped | control
        cosine, sine = math.cos(angle), math.sin(angle)
        for i in range(num_rows):
            if i & mask == mask:
                for place in range(i * num_columns, (i + 1) * num_columns):
                    real, other = entries[place], entries[imaginary + place]
                    entries[place] = cosine * real - sine * other
                    entries[imaginary + place] = sine * real + cosine * other
        return
    cosine, sine = math.cos(HALF * angle), math.sin(HALF * angle)
    for i in range(num_rows):
        partner = i ^ flipped
        if i > partner or (kind == _FLIP and i & control == 0):
            continue
        for column in range(num_columns):
            one, two = i * num_columns + column, partner * num_columns + column
            a, a_i = entries[one], entries[imaginary + one]
            b, b_i = entries[two], entries[imaginary + two]
            if kind == _FLIP:
                entries[one], entries[imaginary + one] = b, b_i
                entries[two], entries[imaginary + two] = a, a_i
            elif kind == _MIX:
                entries[one], entries[imaginary + one] = cosine * a + sine * b_i, cosine * a_i - sine * b
                entries[two], entries[imaginary + two] = cosine * b + sine * a_i, cosine * b_i - sine * a
            else:  # gates.TURN
                # The lower index of the two has the bit 0.
                entries[one], entries[imaginary + one] = cosine * a - sine * b, cosine * a_i - sine * b_i
                entries[two], entries[imaginary + two] = sine * a + cosine * b, sine * a_i + cosine * b_i


@part
def _similarity(entries: Any, num_rows: Any, num_columns: Any) -> Any:
    """Return how well the circuit of a row matches its target; see `rules.similarity`."""
    num = num_rows * num_columns
    if num_columns == 1:
        real, imaginary = ZERO, ZERO
        for i in range(num):
            a, a_i = entries[i], entries[num + i]
            t, t_i = entries[2 * num + i], entries[3 * num + i]
            real += a * t + a_i * t_i
            imaginary += a * t_i - a_i * t
        return min(real * real + imaginary * imaginary, ONE)
    square = ZERO
    for i in range(2 * num):
        difference = entries[i] - entries[2 * num + i]
        square += difference * difference
    return ONE - TWO * _F(math.atan(math.sqrt(square))) / _PI


@part
def _similarity_without_gates(entries: Any, num_rows: Any, num_columns: Any) -> Any:
    """Return how well a circuit without gates matches the target of a row."""
    num = num_rows * num_columns
    if num_columns == 1:
        real, imaginary = entries[2 * num], entries[3 * num]
        return min(real * real + imaginary * imaginary, ONE)
    square = ZERO
    for i in range(num):
        of_identity = ONE if i % (num_columns + 1) == 0 else ZERO
        real, imaginary = entries[2 * num + i] - of_identity, entries[3 * num + i]
        square += real * real + imaginary * imaginary
    return ONE - TWO * _F(math.atan(math.sqrt(square))) / _PI


@part
def _depth_cost(depth: Any, limit: Any) -> Any:
    """Return the cost of a depth: a third of the limit is free."""
    return max(_F(depth) - limit / _F(3.0), ZERO) / (_F(1.5) * limit)


@part
def _draw_target(entries: Any, bits: Any, step: Any, num_rows: Any, num_columns: Any, drawn: Any) -> None:
    """Write a random target into a row; see `rules.random_target`.

    Args:
        drawn: room for the real and imaginary parts, float64 `[2, 8, 8]`.
    """
    num = num_rows * num_columns
    for column in range(num_columns):
        for i in range(num_rows):
            number = 2 * (column * num_rows + i)
            drawn[0, i, column] = kernels.normal(bits, step, number)
            drawn[1, i, column] = kernels.normal(bits, step, number + 1)
        for earlier in range(column):
            real, imaginary = 0.0, 0.0
            for i in range(num_rows):
                e, e_i = drawn[0, i, earlier], drawn[1, i, earlier]
                real += e * drawn[0, i, column] + e_i * drawn[1, i, column]
                imaginary += e * drawn[1, i, column] - e_i * drawn[0, i, column]
            for i in range(num_rows):
                e, e_i = drawn[0, i, earlier], drawn[1, i, earlier]
                drawn[0, i, column] -= real * e - imaginary * e_i
                drawn[1, i, column] -= real * e_i + imaginary * e
        square = 0.0
        for i in range(num_rows):
            square += drawn[0, i, column] ** 2 + drawn[1, i, column] ** 2
        length = math.sqrt(square)
        for i in range(num_rows):
            drawn[0, i, column] /= length
            drawn[1, i, column] /= length
            entries[2 * num + i * num_columns + column] = drawn[0, i, column]
            entries[3 * num + i * num_columns + column] = drawn[1, i, column]


@part
def _below(uniform: Any, num: Any) -> Any:
    """Return a whole number from 0 to `num - 1` for a uniform one in (0, 1)."""
    return min(int(uniform * _F(num)), num - 1)


@part
def _begin_near_target(entries: Any, bits: Any, step: Any, settings: Any, num_rows: Any, num_columns: Any) -> None:
    """Write a circuit near its target into a row without gates.

    The circuit is its target after 0 to `begin_gates` random gates with random angles. The same gates with the opposite
    angles, the last one first, make the target again. If no gate is drawn, the circuit begins without gates.
    """
    num, num_gates = num_rows * num_columns, int(settings[NUM_GATES]) - 1
    number = _below(kernels.uniform(bits, step, rules.NEAR_TARGET), int(settings[BEGIN_GATES]) + 1)
    if number == 0:
        return
    for place in range(2 * num):
        entries[place] = entries[2 * num + place]
    for i in range(number):
        action = _below(kernels.uniform(bits, step, rules.NEAR_TARGET + 1 + 2 * i), num_gates)
        angle = (kernels.uniform(bits, step, rules.NEAR_TARGET + 2 + 2 * i) * TWO - ONE) * _PI
        first = OWN_GATES + NUM_OF_GATE * action
        kind, flipped, control = int(settings[first]), int(settings[first + _FLIPPED]), int(settings[first + _CONTROL])
        _apply(entries, kind, flipped, control, angle, num_rows, num_columns)


@part
def _start(entries: Any, integers: Any, row: Any, bits: Any, step: Any, settings: Any, drawn: Any) -> None:
    """Begin a circuit in a row, without gates or, in training, as the design says.

    A later one of its `beginnings` lacks fewer gates. With `begin_episodes`, training comes to the earlier ones
    gradually.
    """
    num_wires, num_columns, limit = int(settings[WIRES]), int(settings[COLUMNS]), _F(settings[DEPTH])
    num_rows = 1 << num_wires
    num = num_rows * num_columns
    first = OWN_GATES + NUM_OF_GATE * int(settings[NUM_GATES]) * int(settings[NUM_SETS])
    if settings[IS_RANDOM]:
        _draw_target(entries, bits, step, num_rows, num_columns, drawn)
    else:
        for place in range(2 * num):
            entries[2 * num + place] = settings[first + place]
    depth, num_beginnings = 0, int(settings[NUM_BEGINNINGS])
    if num_beginnings > 0 and settings[kernels.EPISODE_STREAM] == TRAINING:
        most, wait = num_beginnings, int(settings[BEGIN_EPISODES])
        if wait > 0 and kernels.uniform(bits, step, 1) >= _F(rules.ANY_BEGINNING):
            most = min(most, 1 + integers[EPISODE_ROW, row] // wait)
        number = num_beginnings - most + _below(kernels.uniform(bits, step, 0), most)
        first += 2 * num + number * (2 * num + num_wires)
        for place in range(2 * num):
            entries[place] = settings[first + place]
        for wire in range(num_wires):
            integers[wire, row] = int(settings[first + 2 * num + wire])
            depth = max(depth, integers[wire, row])
    else:
        for place in range(2 * num):
            entries[place] = ZERO
        for i in range(num_columns):
            entries[i * num_columns + i] = ONE
        for wire in range(num_wires):
            integers[wire, row] = 0
        if settings[BEGIN_GATES] > 0 and settings[kernels.EPISODE_STREAM] == TRAINING:
            _begin_near_target(entries, bits, step, settings, num_rows, num_columns)
    entries[4 * num] = _similarity(entries, num_rows, num_columns)
    entries[4 * num + 1], entries[4 * num + 2] = _depth_cost(depth, limit), ZERO
    integers[_GATE_SET_ROW, row], integers[_GATE_ROW, row] = 0, -1


@part
def _act(entries: Any, integers: Any, row: Any, option: Any, action: Any, given: Any, settings: Any) -> Any:
    """Take an action in a row and return outcome and reward.

    The option counts at the first action of an episode. A gate stands one level above the highest gate on its wires.
    """
    num_wires, num_columns, limit = int(settings[WIRES]), int(settings[COLUMNS]), _F(settings[DEPTH])
    num_rows = 1 << num_wires
    num = num_rows * num_columns
    num_gates, steps = int(settings[NUM_GATES]), integers[STEPS_ROW, row]
    if settings[NUM_SETS] > 1 and steps == 0:
        integers[_GATE_SET_ROW, row] = option
    integers[_GATE_ROW, row] = action
    first = OWN_GATES + NUM_OF_GATE * (integers[_GATE_SET_ROW, row] * num_gates + action)
    kind, flipped, control = int(settings[first]), int(settings[first + _FLIPPED]), int(settings[first + _CONTROL])
    angle = given if settings[first + _HAS_ANGLE] else _F(settings[first + _ANGLE])
    entries[4 * num + 2] = angle
    if kind != _STOP:
        _apply(entries, kind, flipped, control, angle, num_rows, num_columns)
    wires, level, depth = flipped | control, 0, 0
    for wire in range(num_wires):
        if wires >> wire & 1:
            level = max(level, integers[wire, row])
    for wire in range(num_wires):
        if wires >> wire & 1:
            integers[wire, row] = level + 1
        depth = max(depth, integers[wire, row])
    before = entries[4 * num] - entries[4 * num + 1]
    similarity = _similarity(entries, num_rows, num_columns)
    if settings[IS_NATIVE]:
        cost = entries[4 * num + 1] + _F(settings[first + _COST])
    else:
        cost = _depth_cost(depth, limit)
    entries[4 * num], entries[4 * num + 1] = similarity, cost
    has_ended = kind == _STOP or depth >= limit or steps + 1 >= settings[kernels.MAX_STEPS]
    outcome = rules.BUILDING
    if has_ended:
        outcome = rules.MATCHED if similarity >= _MATCH else rules.MISSED
    score = similarity - cost
    if settings[REWARD] == _PROGRESS:
        return outcome, score - before
    if not has_ended:
        return outcome, ZERO
    if settings[REWARD] == _GAIN:
        floor = _F(settings[FLOOR])
        if math.isnan(floor):
            floor = _similarity_without_gates(entries, num_rows, num_columns)
        return outcome, max(score - floor, ZERO)
    return outcome, score


@part
def _observe(entries: Any, integers: Any, row: Any, settings: Any, observation: Any) -> None:
    """Write what is observed of a row: circuit and target and, if so set, the wires' depths as parts of the limit."""
    num_wires = int(settings[WIRES])
    num = 4 * (1 << num_wires) * int(settings[COLUMNS])
    for place in range(num):
        observation[place] = entries[place]
    if settings[OBSERVES_DEPTH]:
        for wire in range(num_wires):
            observation[num + wire] = _F(integers[wire, row]) / _F(settings[DEPTH])


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
    of_similarity = 4 * (1 << int(settings[WIRES])) * int(settings[COLUMNS])
    drawn = np.empty((2, _MOST_ROWS, _MOST_ROWS))
    block = np.empty((_SIDE_BY_SIDE, len(floats)), np.float32)
    for first in range(0, len(mask), _SIDE_BY_SIDE):
        num = min(_SIDE_BY_SIDE, len(mask) - first)
        for place in range(len(floats)):
            for i in range(num):
                block[i, place] = floats[place, first + i]
        for i in range(num):
            row, entries = first + i, block[i]
            was_over = integers[OUTCOME_ROW, row] != rules.BUILDING
            if mode != kernels.RESTART and mask[row] and not was_over:
                action = discrete[row]
                given = kernels.parameter(parameters, row, 0, action)
                outcome, rewards[row] = _act(entries, integers, row, option[row], action, given, settings)
                kernels.end_step(integers, row, outcome, len(rules.OUTCOMES), settings)
            for reading in range(len(observations)):
                if kernels.must_restart(mode, reading, was_over, integers[OUTCOME_ROW, row], mask[row]):
                    bits, step = kernels.new_episode(integers, row, settings)
                    _start(entries, integers, row, bits, step, settings, drawn)
                _observe(entries, integers, row, settings, observations[reading, row])
                extras[reading, 0, row] = entries[of_similarity]
                extras[reading, 1, row] = entries[of_similarity + 1]
                kernels.report(integers[OUTCOME_ROW, row], len(rules.OUTCOMES), row, outcomes[reading], flags[reading])
        for place in range(len(floats)):
            for i in range(num):
                floats[place, first + i] = block[i, place]
    return -1
