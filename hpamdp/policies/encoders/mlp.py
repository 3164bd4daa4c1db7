"""Flattened pictures, for learners that read vectors."""

from __future__ import annotations

from hpamdp.policies.encoders.base import Encoder
from hpamdp.policies.encoders.options import CARDS


class MLP(Encoder):
    """Makes pictures part of the vector, which each learner and selector reads by its own networks.

    It has no weights. Replay buffers hold the pixels as float32.
    """

    card = CARDS["MLP"]
