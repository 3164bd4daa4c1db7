"""The shortest known circuits of fixed targets."""

from __future__ import annotations

import math
from collections.abc import Mapping

_RIGHT = 0.5 * math.pi
_HADAMARD_2 = (("p 2", _RIGHT), ("rx 2", _RIGHT), ("p 2", _RIGHT))

# Circuits with the published gates that make the fixed targets, with the angle of each gate.
CIRCUITS: Mapping[str, tuple[tuple[str, float], ...]] = {
    "hadamard": (("p 0", _RIGHT), ("rx 0", _RIGHT), ("p 0", _RIGHT)),
    "bell": (("rx 0", _RIGHT), ("p 0", _RIGHT), ("cx 0 1", 0.0)),
    "ghz": (("rx 0", _RIGHT), ("p 0", _RIGHT), ("cx 0 1", 0.0), ("cx 1 2", 0.0)),
    # Nielsen and Chuang, *Quantum Computation and Quantum Information*, section 4.3, with V the square root of X.
    "toffoli": (
        *_HADAMARD_2,
        ("cp 1 2", _RIGHT),
        ("cx 0 1", 0.0),
        ("cp 1 2", -_RIGHT),
        ("cx 0 1", 0.0),
        ("cp 0 2", _RIGHT),
        *_HADAMARD_2,
    ),
}
