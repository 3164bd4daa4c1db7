"""What all random numbers of batched environments share: how seeds are folded, and the streams with their steps."""

from __future__ import annotations

from hashlib import sha256

# Training and evaluation episodes, and the noise in training and in evaluation.
TRAINING, EVALUATION, NOISE, EVALUATION_NOISE = range(4)

# Number `index` of a key is the hash of `bits + index * step`. An odd step visits all 2^32 values before it repeats one
# (a Weyl sequence). Each stream has its own step, and no difference of two steps is a multiple of 8. So the sequences
# of two streams, shifted or not, share at most one value in 2^30 indices. Whatever the seeds, no stream repeats the
# numbers of another. The steps are signed because the hash works on int32 tensors.
STEPS = (-0x7A143595, -0x61C88647, 0x27D4EB2F, 0x165667BD)


def folded(seed: int) -> int:
    """Return the 32 bits of a seed that all random numbers depend on, unsigned.

    An int32 or a uint32 keeps its own bits. Larger numbers are hashed, so that a large seed is unlikely to share its
    episodes with a small one.
    """
    if -(2**31) <= seed < 2**32:
        return seed & 0xFFFFFFFF
    return int.from_bytes(sha256(str(seed).encode()).digest()[:4], "big")
