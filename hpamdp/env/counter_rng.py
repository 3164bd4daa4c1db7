"""Random numbers that are pure functions of integer counters.

`torch.rand` reads one stream, so what one environment gets depends on how often the others were reset, and a number
for every row costs more than a step of the physics. Here each number is a hash of (seed, stream, environment, episode,
index): the episodes of an environment do not depend on the batch, and no global generator is touched.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hpamdp.env.rng_streams import EVALUATION, EVALUATION_NOISE, NOISE, STEPS, TRAINING

# How to compile functions that draw random numbers. Each operation of the hash reads its input twice, and the
# compiler's default of inlining them into one another takes it two minutes. Measured with 16,384 environments: with
# these thresholds compiling takes 4 s, and step and reset make 50 million steps/s; with (8, 2) and (20, 4) 21 million.
COMPILE_ARGUMENTS: dict[str, Any] = {
    "fullgraph": True,
    "dynamic": False,
    "options": {"realize_opcount_threshold": 16, "realize_reads_threshold": 4},
}


class RngKey(NamedTuple):
    """What all random numbers of an episode derive from.

    Attributes:
        bits: int32 `[*B]`, the hash of the seed, the environment and the episode.
        step: of the stream.
    """

    bits: Tensor
    step: int


def _shift_right(h: Tensor, bits: int) -> Tensor:
    """Shift int32 right without copying the sign."""
    return (h >> bits) & ((1 << (32 - bits)) - 1)


def _mix(h: Tensor) -> Tensor:
    """Scramble int32 bijectively (the finaliser `lowbias32`, Wellons 2018); products wrap modulo 2^32."""
    h = (h ^ _shift_right(h, 16)) * 0x7FEB352D
    h = (h ^ _shift_right(h, 15)) * -0x7B935975  # 0x846ca68b as a signed number
    return h ^ _shift_right(h, 16)


def rng_key(seed: Tensor, stream: int, environment: Tensor, episode: Tensor) -> RngKey:
    """Return the key `[*B]` of an episode.

    Args:
        seed: int32 scalar, from `seed_tensor`.
        stream: TRAINING, EVALUATION, NOISE or EVALUATION_NOISE.
        environment: int32 `[*B]`, the numbers of the environments.
        episode: int32 `[*B]`, the numbers of their episodes.
    """
    h = _mix(seed ^ (0x2545F491 + 0x01234567 * stream))
    h = _mix(h ^ environment)
    return RngKey(_mix(h ^ episode), STEPS[stream])


def uniform(key: RngKey, index: int | Tensor) -> Tensor:
    """Return float32 in (0, 1): number `index` of each key; an `index` that is an int32 tensor broadcasts with them."""
    # 23 bits: with 24, adding a half would round up to 1 in the upper half of the interval.
    bits = _shift_right(_mix(key.bits + index * key.step), 9)
    return (bits.to(torch.float32) + 0.5) * 2.0**-23


def normal(key: RngKey, index: int | Tensor) -> Tensor:
    """Return standard normal float32 `[*B]` (Box-Muller), from the uniform numbers `2 index` and `2 index + 1`."""
    radius = (-2.0 * uniform(key, 2 * index).log()).sqrt()
    return radius * (2.0 * math.pi * uniform(key, 2 * index + 1)).cos()


def seed_tensor(seed: int, device: torch.device | None = None) -> Tensor:
    """Fold a Python integer of any size into the int32 scalar that `rng_key` takes."""
    folded = (seed ^ (seed >> 32)) & 0xFFFFFFFF
    signed = folded - (1 << 32) if folded >= 1 << 31 else folded
    return torch.tensor(signed, dtype=torch.int32, device=device)
