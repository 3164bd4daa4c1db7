"""The gates of a circuit, by sets: what each does to the amplitudes, which wires it takes, and what it costs.

An index of the amplitudes is a number of n bits; bit w is the value of wire w, as in Qiskit. Wires are numbered from 0.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

# What gates do. STOP ends the circuit.
STOP, PHASE, MIX, TURN, FLIP = range(5)


class Gate(NamedTuple):
    """A gate on certain wires.

    With the angle t, and with a, b for the amplitudes of an index and its partner, the kinds are:
    - PHASE: amplitudes whose index has all bits of `flipped | control` are multiplied by exp(i t);
    - MIX: a becomes cos(t/2) a - i sin(t/2) b; the partner differs in all bits of `flipped`;
    - TURN: a, with the bit 0, becomes cos(t/2) a - sin(t/2) b, and b becomes sin(t/2) a + cos(t/2) b;
    - FLIP: amplitudes whose index has the bit of `control` change places with their partner.

    Attributes:
        name: as in OpenQASM, such as `cx 1 0`: the control first.
        kind: STOP, PHASE, MIX, TURN or FLIP.
        flipped: bits in which the partner's index differs; the wires that the gate changes.
        control: bits that have to be 1, or 0 if the gate is not controlled.
        angle: the angle of a gate without a parameter; None if the agent chooses it.
        cost: subtracted from the score for each use, in the native sets.
    """

    name: str
    kind: int
    flipped: int = 0
    control: int = 0
    angle: float | None = 0.0
    cost: float = 0.0

    @property
    def wires(self) -> int:
        """The bits of all wires that the gate takes."""
        return self.flipped | self.control


_STOP = Gate("stop", STOP)


def published(n: int) -> tuple[Gate, ...]:
    """Return the 2 n^2 + 1 discrete actions of the source: phases, then rotations about x and CNOTs, then the stop."""
    phases, flips = [], []
    for wire, control in itertools.product(range(n), repeat=2):
        if wire == control:
            phases.append(Gate(f"p {wire}", PHASE, 1 << wire, angle=None))
            flips.append(Gate(f"rx {wire}", MIX, 1 << wire, angle=None))
        else:
            phases.append(Gate(f"cp {control} {wire}", PHASE, 1 << wire, 1 << control, angle=None))
            flips.append(Gate(f"cx {control} {wire}", FLIP, 1 << wire, 1 << control))
    return (*phases, *flips, _STOP)


def superconducting(n: int, one_cost: float, two_cost: float) -> tuple[Gate, ...]:
    """Return the gates of superconducting machines: RZ, which costs nothing there, SX and CX, and the stop.

    RZ(t) is a phase gate and SX is RX(pi/2), but for a global phase, which no state has.
    """
    return (
        *(Gate(f"rz {wire}", PHASE, 1 << wire, angle=None) for wire in range(n)),
        *(Gate(f"sx {wire}", MIX, 1 << wire, angle=0.5 * math.pi, cost=one_cost) for wire in range(n)),
        *(Gate(f"cx {a} {b}", FLIP, 1 << b, 1 << a, cost=two_cost) for a, b in itertools.permutations(range(n), 2)),
        _STOP,
    )


def ion(n: int, one_cost: float, two_cost: float) -> tuple[Gate, ...]:
    """Return the gates of machines with trapped ions: RX, RY and XX, each with an angle, and the stop.

    XX stands twice for each pair, so that every action is a gate on the same wires in both native sets.
    """
    return (
        *(Gate(f"rx {wire}", MIX, 1 << wire, angle=None, cost=one_cost) for wire in range(n)),
        *(Gate(f"ry {wire}", TURN, 1 << wire, angle=None, cost=one_cost) for wire in range(n)),
        *(
            Gate(f"xx {a} {b}", MIX, 1 << a | 1 << b, angle=None, cost=two_cost)
            for a, b in itertools.permutations(range(n), 2)
        ),
        _STOP,
    )


def matrices(gates: tuple[Gate, ...], n: int) -> Tensor:
    """Return what makes up each gate's operator, complex64 `[K, 3, 2^n, 2^n]`.

    With the three matrices A, B, C of a gate, its operator at the angle t is A + cos(u) B + sin(u) C. Here u is t for
    PHASE and t/2 otherwise.
    """
    num = 1 << n
    table = torch.zeros(len(gates), 3, num, num, dtype=torch.complex64)
    for gate, (fixed, of_cosine, of_sine) in zip(gates, table, strict=True):
        for index in range(num):
            partner = index ^ gate.flipped
            if gate.kind == PHASE:
                is_turned = index & gate.wires == gate.wires
                (of_cosine if is_turned else fixed)[index, index] = 1.0
                of_sine[index, index] = 1j if is_turned else 0.0
            elif gate.kind == MIX:
                of_cosine[index, index] = 1.0
                of_sine[index, partner] = -1j
            elif gate.kind == TURN:
                of_cosine[index, index] = 1.0
                of_sine[index, partner] = 1.0 if index & gate.flipped else -1.0
            else:
                fixed[index, partner if gate.kind == FLIP and index & gate.control else index] = 1.0
    return table
