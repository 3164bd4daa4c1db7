"""The streams of random numbers: what they are for, and how their numbers follow from counters."""

from __future__ import annotations

# The episodes of training and of evaluation, and the noise in either.
TRAINING, EVALUATION, NOISE, EVALUATION_NOISE = range(4)

# Number `index` of a key is the hash of `bits + index * step`. An odd step visits all 2^32 values before it repeats one
# (a Weyl sequence). Each stream has its own, and no difference of two is a multiple of 8, so the sequences of two
# streams, shifted or not, have at most one value in common in 2^30 indices. Whatever the seeds, no stream repeats the
# numbers of another. Signed, as torch wants them.
STEPS = (-0x7A143595, -0x61C88647, 0x27D4EB2F, 0x165667BD)
