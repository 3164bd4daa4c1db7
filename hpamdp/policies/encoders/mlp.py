"""Pictures as vectors: the user asks for a flattened picture."""

from __future__ import annotations

from typing import ClassVar

from hpamdp.policies.encoders.base import Encoder


class MLP(Encoder):
    """Make pictures part of the vector, which each learner and selector reads by its own networks.

    There are no weights of its own. The replay buffers hold the pixels as float32.
    """

    flattens: ClassVar[bool] = True
