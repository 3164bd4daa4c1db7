"""Random numbers that are pure functions of integer counters.

`torch.rand` draws from one stream, so what one environment gets depends on how often the others were reset, and a draw
for every row costs more than a step of the physics. Here each number is a hash of (seed, stream, environment, episode,
draw): every environment's episodes are its own, whatever the batch, and nothing touches the global generator.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

# Separate streams, so that evaluation layouts are never met in training and switching a noise on moves no layout.
TRAINING, EVALUATION, NOISE = range(3)


def _shift_right(h: Tensor, bits: int) -> Tensor:
    """Shift int32 right without copying the sign."""
    return (h >> bits) & ((1 << (32 - bits)) - 1)


def _mix(h: Tensor) -> Tensor:
    """Scramble int32 bijectively (the finaliser `lowbias32`, Wellons 2018); products wrap modulo 2^32."""
    h = (h ^ _shift_right(h, 16)) * 0x7FEB352D
    h = (h ^ _shift_right(h, 15)) * -0x7B935975  # 0x846ca68b as a signed number
    return h ^ _shift_right(h, 16)


def key_for(seed: Tensor, stream: int, environment: Tensor, episode: Tensor) -> Tensor:
    """Return the int32 `[*B]` key from which an episode's draws are derived; all inputs int32."""
    h = _mix(seed ^ (0x2545F491 + 0x01234567 * stream))
    h = _mix(h ^ environment)
    return _mix(h ^ episode)


def uniform(key: Tensor, draw: int | Tensor) -> Tensor:
    """Return float32 `[*B]` in (0, 1), the `draw`-th number of each key; `draw` may be an int32 tensor."""
    # An odd step walks through all 2^32 states before it comes back (Weyl sequence), `_mix` hides the walk.
    # 23 bits: with one more the half would be rounded away in the upper half, up to 1.
    bits = _shift_right(_mix(key + draw * -0x61C88647), 9)
    return (bits.to(torch.float32) + 0.5) * 2.0**-23


def normal(key: Tensor, draw: int | Tensor) -> Tensor:
    """Return standard normal float32 `[*B]` (Box-Muller) from draws `2 draw` and `2 draw + 1`."""
    radius = (-2.0 * uniform(key, 2 * draw).log()).sqrt()
    return radius * (2.0 * math.pi * uniform(key, 2 * draw + 1)).cos()


def seed_tensor(seed: int, device: torch.device | None = None) -> Tensor:
    """Fold a Python integer of any size into the int32 scalar that `key_for` takes."""
    folded = (seed ^ (seed >> 32)) & 0xFFFFFFFF
    return torch.tensor(folded - (1 << 32) if folded >= 1 << 31 else folded, dtype=torch.int32, device=device)
