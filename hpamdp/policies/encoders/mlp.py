"""Flattened pictures, for learners that read vectors."""

from __future__ import annotations

from typing import ClassVar

from hpamdp.policies.encoders.base import Encoder


class MLP(Encoder):
    """Makes pictures part of the vector, which each learner and selector reads by its own networks.

    It has no weights. Replay buffers hold the pixels as float32.
    """

    flattens: ClassVar[bool] = True
