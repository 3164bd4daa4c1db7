"""Counter-based random numbers: pure functions of integers, such as the number of the episode.

`torch.rand` reads one stream. The numbers of one environment would depend on how often the others were reset. Drawing
a number for every row would also cost more than a step of the physics.

Here each number is a hash of (seed, stream, environment, episode, index). The episodes of an environment do not depend
on the batch, and the global generators are not used.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env.rng_streams import EVALUATION, EVALUATION_NOISE, NOISE, STEPS, TRAINING, folded


class RngKey(NamedTuple):
    """The key from which all random numbers of an episode derive.

    Attributes:
        bits: hash of the seed, the stream, the environment and the episode, int32 `[*B]`.
        step: step of the stream, from `STEPS`.
    """

    bits: Tensor
    step: int


def _shift_right(h: Tensor, bits: int) -> Tensor:
    """Shift int32 right without extending the sign."""
    return (h >> bits) & ((1 << (32 - bits)) - 1)


def _mix(h: Tensor) -> Tensor:
    """Scramble int32 bijectively (the finaliser `lowbias32`, Wellons 2018); products wrap modulo 2^32."""
    h = (h ^ _shift_right(h, 16)) * 0x7FEB352D
    h = (h ^ _shift_right(h, 15)) * -0x7B935975  # 0x846ca68b as a signed number
    return h ^ _shift_right(h, 16)


def rng_key(seed: Tensor, stream: int, environment: Tensor, episode: Tensor) -> RngKey:
    """Return the key `[*B]` of an episode.

    Args:
        seed: int32 scalar from `seed_tensor`.
        stream: TRAINING, EVALUATION, NOISE or EVALUATION_NOISE.
        environment: numbers of the environments, int32 `[*B]`.
        episode: numbers of their episodes, int32 `[*B]`.
    """
    h = _mix(seed ^ (0x2545F491 + 0x01234567 * stream))
    h = _mix(h ^ environment)
    return RngKey(_mix(h ^ episode), STEPS[stream])


def uniform(key: RngKey, index: int | Tensor) -> Tensor:
    """Return uniform number `index` of each key, float32 in (0, 1).

    An int32 tensor `index` broadcasts against the keys.
    """
    # Use 23 bits. With 24, adding 0.5 could round the largest values up to 1.
    bits = _shift_right(_mix(key.bits + index * key.step), 9)
    return (bits.to(torch.float32) + 0.5) * 2.0**-23


def normal(key: RngKey, index: int | Tensor) -> Tensor:
    """Return standard normal float32 `[*B]` (Box-Muller), from the uniform numbers `2 index` and `2 index + 1`."""
    radius = (-2.0 * uniform(key, 2 * index).log()).sqrt()
    return radius * (2.0 * math.pi * uniform(key, 2 * index + 1)).cos()


def seed_tensor(seed: int, device: torch.device | None = None) -> Tensor:
    """Fold a Python integer of any size into the int32 scalar for `rng_key`."""
    bits = folded(seed)
    return torch.tensor(bits - 2**32 if bits >= 2**31 else bits, dtype=torch.int32, device=device)
