"""Families of boats: where the keys of a boat push, how strongly, and how far the boat glides.

A boat is an int32 number, its *bits*, from which its properties are drawn. Bits of boats for training are even and
those of test boats are odd, so no training meets a test boat.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hpamdp.env import counter_rng
from hpamdp.env.boatdock.task import NUM_KEYS
from hpamdp.env.boatdock_unseen.options import FleetRules
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.rng_streams import STEPS, TRAINING

# Indices of a boat's random numbers.
TURN, ORDER, FIRST_GAP, SECOND_GAP, STRENGTH, GLIDE = range(6)
NUM_ORDERS = 6  # in which three keys can have three directions


class Boats(NamedTuple):
    """What N boats do.

    Attributes:
        directions: unit directions (x, y) of the keys, float32 `[N, 3, 2]`.
        strength: their speed, as a multiple of that of people's boats, `[N]`.
        glide: the length of their glide, as a multiple of that of people's boats, `[N]`.
    """

    directions: Tensor
    strength: Tensor
    glide: Tensor


def key_of(bits: Tensor) -> RngKey:
    """Return the random-number keys of boats `[*B]`."""
    return RngKey(bits, STEPS[TRAINING])


def boats(bits: Tensor, rules: FleetRules) -> Boats:
    """Return the boats with these bits, int32 `[N]`."""
    keys = [torch.full_like(bits, number) for number in range(NUM_KEYS)]
    directions = torch.stack([torch.stack(direction(bits, key, rules), -1) for key in keys], 1)
    return Boats(directions, *strength_and_glide(bits, rules))


def direction(bits: Tensor, key: Tensor, rules: FleetRules) -> tuple[Tensor, Tensor]:
    """Return the unit direction (x, y) of a key `[*B]` of each boat, float32 `[*B]` each."""
    rng = key_of(bits)
    # The six orders are three shifts of the keys, and the same after a mirror.
    order = (counter_rng.uniform(rng, ORDER) * NUM_ORDERS).to(torch.int32)
    shift = order % NUM_KEYS
    slot = torch.where(order < NUM_KEYS, key + shift, shift - key + NUM_KEYS) % NUM_KEYS
    if rules.family == "any":
        first, second = counter_rng.uniform(rng, FIRST_GAP), counter_rng.uniform(rng, SECOND_GAP)
        free = 2.0 * math.pi - NUM_KEYS * rules.separation
        # The three gaps between neighbours are uniform among those of at least `separation`.
        low, high = torch.minimum(first, second), torch.maximum(first, second)
        one, two = rules.separation + free * low, 2.0 * rules.separation + free * high
        offset = torch.where(slot == 0, 0.0, torch.where(slot == 1, one, two))
    else:
        offset = slot.to(torch.float32) * (2.0 * math.pi / NUM_KEYS)
    angle = 2.0 * math.pi * counter_rng.uniform(rng, TURN) + offset
    return angle.cos(), angle.sin()


def strength_and_glide(bits: Tensor, rules: FleetRules) -> tuple[Tensor, Tensor]:
    """Return speed and glide of each boat, as multiples of those of people's boats, float32 `[*B]` each."""
    if rules.family != "strength":
        ones = torch.ones(bits.shape, device=bits.device, dtype=torch.float32)
        return ones, ones
    rng = key_of(bits)
    strength, glide = (
        1.0 + rules.spread * (2.0 * counter_rng.uniform(rng, index) - 1.0) for index in (STRENGTH, GLIDE)
    )
    return strength, glide
