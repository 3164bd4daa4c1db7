"""The best circuits of each native gate set for states of two wires: a search over all forms of circuits.

A form is a sequence of gates with free angles. `forms` lists those that can be best, the cheapest first. For each
target and form, `_ascend` finds the best angles by coordinate ascent from several starts. In one angle the fidelity is
a sinusoid, so each step goes to its maximum at once (Nakanishi, Fujii and Todo 2020, arXiv:1903.12166; Ostaszewski,
Grant and Benedetti 2021, arXiv:1905.09692).

One entangling gate suffices for a fidelity of 1. Rotations before the gate set the Schmidt coefficients, and rotations
after it do the rest. That takes CX and six SX, or XX and five rotations. No circuit that costs more can
be best.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from hpamdp.env.circuit import gates
from hpamdp.env.circuit.gates import Gate
from hpamdp.env.kernels import kernel, part

WIRES = 2
_NUM = 1 << WIRES  # amplitudes
_STARTS = 6  # of the ascent of a form
_MOST_SWEEPS = 60
_TOLERANCE = 1e-7  # gain of a sweep below which the ascent ends
_TRIFLE = 1e-4  # angle below which a gate is left out of a circuit
_PHASE, _MIX, _TURN, _FLIP = gates.PHASE, gates.MIX, gates.TURN, gates.FLIP
_Stretch = tuple[str, ...]  # rotations of one wire between two entangling gates


class Plans(NamedTuple):
    """The best circuits for M targets.

    Attributes:
        score: fidelity less cost, `[M]`.
        gates: numbers of the gates in the set, with the stop after the last one, int64 `[M, L]`.
        angles: their angles, `[M, L]`.
    """

    score: np.ndarray
    gates: np.ndarray
    angles: np.ndarray


@cache
def forms(gate_set: tuple[Gate, ...]) -> tuple[tuple[int, ...], ...]:
    """Return the forms of circuits that can be best, as numbers of gates in a native set, the cheapest first."""
    is_superconducting = any(gate.kind == _FLIP for gate in gate_set)
    make, rotations = (_superconducting_forms, 6) if is_superconducting else (_ion_forms, 5)
    one_cost, two_cost = gate_set[WIRES].cost, gate_set[2 * WIRES].cost
    most = two_cost + rotations * one_cost
    found: set[tuple[int, ...]] = set()
    for entangling in itertools.count():
        left = int((most - entangling * two_cost) / one_cost + 1e-6)
        # With fewer rotations than gaps between entangling gates, two of these would follow each other directly.
        if left < max(0, entangling - 1):
            break
        found.update(make(entangling, left))
    return tuple(sorted(found, key=lambda form: (_cost(form, gate_set), form)))


def _cost(form: Sequence[int], gate_set: Sequence[Gate]) -> float:
    return sum(gate_set[number].cost for number in form)


def _stretches(choices: Sequence[Sequence[_Stretch]], left: int) -> Iterator[tuple[_Stretch, ...]]:
    """Yield one stretch of each of the choices, with at most `left` rotations in all of them."""
    if not choices:
        yield ()
        return
    for stretch in choices[0]:
        if len(stretch) <= left:
            for others in _stretches(choices[1:], left - len(stretch)):
                yield (stretch, *others)


def _superconducting_forms(entangling: int, left: int) -> Iterator[tuple[int, ...]]:
    """Yield SX and CX in every useful order, with RZ wherever it has an effect.

    The gates are rz 0, rz 1, sx 0, sx 1, cx 0 1, cx 1 0. With RZ around them, two SX make any rotation.
    """
    some: list[_Stretch] = [(), ("x",), ("x", "x")]
    for stretches in _stretches([some] * (WIRES * (entangling + 1)), left):
        for flips in itertools.product((4, 5), repeat=entangling):
            form: list[int] = []
            for number, stretch in enumerate(stretches):
                wire = number % WIRES
                form += [wire, 2 + wire] * len(stretch)
                if wire == WIRES - 1 and number < WIRES * entangling:
                    form += [0, 1, flips[number // WIRES]]
            yield (*form, 0, 1)


def _ion_forms(entangling: int, left: int) -> Iterator[tuple[int, ...]]:
    """Yield RX, RY and XX in every useful order.

    The gates are rx 0, rx 1, ry 0, ry 1, xx 0 1. On a wire RX and RY take turns, since two of a kind make one, and
    three make any rotation. XX commutes with RX, so no RX stands right before it.
    """
    turns: list[_Stretch] = [(), ("x",), ("y",), ("x", "y"), ("y", "x"), ("x", "y", "x"), ("y", "x", "y")]
    before = [each for each in turns if not each or each[-1] == "y"]
    for stretches in _stretches([before] * (WIRES * entangling) + [turns] * WIRES, left):
        form: list[int] = []
        for number, stretch in enumerate(stretches):
            wire = number % WIRES
            form += [wire + (2 if axis == "y" else 0) for axis in stretch]
            if wire == WIRES - 1 and number < WIRES * entangling:
                form.append(4)
        yield tuple(form)


def best(targets: np.ndarray, gate_set: tuple[Gate, ...]) -> Plans:
    """Return the best circuits of a native set for states of two wires, complex `[M, 4]`."""
    listed = forms(gate_set)
    longest, num = max(map(len, listed)), len(targets)
    numbers = np.full((len(listed), longest), -1, np.int64)
    for row, form in zip(numbers, listed, strict=True):
        row[: len(form)] = form
    operations = np.array([[gate.kind, gate.flipped, gate.control] for gate in gate_set], np.int64)
    fixed = np.array([math.nan if gate.angle is None else gate.angle for gate in gate_set])
    costs = np.array([_cost(form, gate_set) for form in listed])
    starts = np.random.default_rng(0).uniform(-math.pi, math.pi, (_STARTS, longest))
    score, form_of, angles = np.full(num, -np.inf), np.zeros(num, np.int64), np.zeros((num, longest))
    found = score, form_of, angles
    _search(np.ascontiguousarray(targets, np.complex128), numbers, operations, fixed, costs, starts, found)
    chosen = numbers[form_of]
    is_kept = (chosen >= 0) & ((np.abs(angles) > _TRIFLE) | (operations[chosen, 0] == _FLIP))
    order = np.argsort(~is_kept, axis=1, kind="stable")
    stop = np.full((num, 1), len(gate_set) - 1)
    kept = np.where(is_kept, chosen, len(gate_set) - 1)
    return Plans(
        score,
        np.concatenate([np.take_along_axis(kept, order, 1), stop], 1),
        np.concatenate([np.take_along_axis(np.where(is_kept, angles, 0.0), order, 1), np.zeros((num, 1))], 1),
    )


@part
def _apply(state: Any, kind: Any, flipped: Any, control: Any, angle: Any, after: Any) -> None:
    """Write the state after a gate into `after`.

    Args:
        state: the state before the gate, complex `[4]`.
        kind, flipped, control: see `gates.Gate`.
        angle: the gate's angle, rad.
        after: room for the state after the gate, complex `[4]`; not `state` itself.
    """
    cosine, sine = math.cos(0.5 * angle), math.sin(0.5 * angle)
    for i in range(_NUM):
        other = state[i ^ flipped]
        if kind == _PHASE:
            mask = flipped | control
            after[i] = state[i] * complex(math.cos(angle), math.sin(angle)) if i & mask == mask else state[i]
        elif kind == _MIX:
            after[i] = cosine * state[i] - 1j * sine * other
        elif kind == _TURN:
            after[i] = cosine * state[i] + (sine if i & flipped else -sine) * other
        else:
            after[i] = other if i & control else state[i]


@part
def _best_angle(before: Any, after: Any, kind: Any, flipped: Any) -> Any:
    """Return the angle of a gate that brings the state before it nearest to the wanted state after it."""
    kept, moved = 0j, 0j  # the overlap is kept + exp(i t) moved, or cos(t/2) kept + sin(t/2) moved
    for i in range(_NUM):
        wanted = after[i].conjugate()
        if kind == _PHASE:
            if i & flipped:
                moved += wanted * before[i]
            else:
                kept += wanted * before[i]
        else:
            other = before[i ^ flipped]
            kept += wanted * before[i]
            moved += wanted * (-1j * other if kind == _MIX else (other if i & flipped else -other))
    product = kept * moved.conjugate()
    if kind == _PHASE:
        return math.atan2(product.imag, product.real)
    difference = kept.real**2 + kept.imag**2 - moved.real**2 - moved.imag**2
    return math.atan2(2.0 * product.real, difference)


@part
def _ascend(
    target: Any, form: Any, length: Any, operations: Any, fixed: Any, angles: Any, wanted: Any, states: Any
) -> Any:
    """Improve the angles of a form in place, and return the fidelity.

    Args:
        target: the state to reach, complex `[4]`.
        form: numbers of the gates in the set, `[L]`, of which the first `length` count.
        length: number of gates of the form.
        operations: kind, flipped and control of each gate of the set, `[G, 3]`; see `gates.Gate`.
        fixed: the angle of each gate of the set, `[G]`; NaN where it is free.
        angles: the angles of the form's gates, `[L]`, changed in place.
        wanted: room for what the states after each gate should be, complex `[L + 1, 4]`.
        states: room for two states, complex `[2, 4]`.
    """
    fidelity = -1.0
    for _ in range(_MOST_SWEEPS):
        wanted[length] = target
        for place in range(length - 1, -1, -1):
            kind, flipped, control = operations[form[place]]
            _apply(wanted[place + 1], kind, flipped, control, -angles[place], wanted[place])
        states[0] = 0.0
        states[0, 0] = 1.0
        for place in range(length):
            kind, flipped, control = operations[form[place]]
            now, after = place % 2, 1 - place % 2
            if math.isnan(fixed[form[place]]):
                angles[place] = _best_angle(states[now], wanted[place + 1], kind, flipped)
            _apply(states[now], kind, flipped, control, angles[place], states[after])
        overlap = 0j
        for i in range(_NUM):
            overlap += target[i].conjugate() * states[length % 2, i]
        reached = overlap.real**2 + overlap.imag**2
        if reached - fidelity < _TOLERANCE:
            return reached
        fidelity = reached
    return fidelity


@kernel
def _search(targets: Any, forms: Any, operations: Any, fixed: Any, costs: Any, starts: Any, found: Any) -> None:
    """Find for each target the best score, the number of its form and the angles, and write them into `found`."""
    scores, best_forms, best_angles = found
    longest = forms.shape[1]
    wanted = np.zeros((longest + 1, _NUM), np.complex128)
    states = np.zeros((2, _NUM), np.complex128)
    angles = np.zeros(longest)
    for row in range(len(targets)):
        for number in range(len(forms)):
            if 1.0 - costs[number] <= scores[row]:
                break
            length = 0
            while length < longest and forms[number, length] >= 0:
                length += 1
            for start in range(len(starts)):
                for place in range(length):
                    given = fixed[forms[number, place]]
                    angles[place] = starts[start, place] if math.isnan(given) else given
                fidelity = _ascend(targets[row], forms[number], length, operations, fixed, angles, wanted, states)
                if fidelity - costs[number] > scores[row]:
                    scores[row], best_forms[row] = fidelity - costs[number], number
                    best_angles[row, :length] = angles[:length]
                    best_angles[row, length:] = 0.0
