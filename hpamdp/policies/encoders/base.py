"""The contract of encoders, and the module that concatenates the features of all entries of an observation."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from hpamdp.cards import EncoderCard
from hpamdp.observation_entries import ObservationEntry
from hpamdp.specs import PAMDPSpecs

# Rows that are encoded at once if no gradient is needed. Larger pieces are slower on a CPU: they exceed its caches.
_PIECE = 256


class Encoder(nn.Module):
    """Turn one entry of the observation, a picture, into features.

    A learner makes one encoder for each entry that is a picture, and trains it together with its own networks. Vectors
    are passed on unchanged::

        class Downscaled(Encoder):  # mean colours on a grid of 8 x 8
            def __init__(self, entry: ObservationEntry) -> None:
                super().__init__(entry)
                self.num_features = 64 * entry.picture_shape[0]

            def forward(self, values: Tensor) -> Tensor:
                return F.adaptive_avg_pool2d(values, 8).flatten(1)

    Constructor: `entry` is the entry. Settings are fields of a model `Options`, see `hpamdp.settings`, or keyword-only
    arguments. Their names and types are the schema of the encoder's yaml in `conf/encoder`.

    Attributes:
        entry: name, place and shape of the picture in the observation.
        num_features: number of features. A subclass sets it.
        card: what the class declares.
    """

    card: ClassVar[EncoderCard] = EncoderCard()

    num_features: int

    def __init__(self, entry: ObservationEntry) -> None:
        super().__init__()
        self.entry = entry

    def forward(self, values: Tensor) -> Tensor:
        """Return features float32 `[B, num_features]`.

        Args:
            values: pictures float32 `[B, C, H, W]` in [0, 1].
        """
        raise NotImplementedError(f"{type(self).__name__} has no forward")


class JoinedEncoders(nn.Module):
    """Concatenate the features of all entries of an observation; the one-hot option stays at the end.

    Args:
        specs: of the learner or the selector. `specs.encoder` makes the encoders; by default a `CNN` for each picture.

    Attributes:
        feature_specs: the specs with the features as observation. They have no initial parameters, symmetries or
            geometry, because problems declare these of observations.
    """

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        make: Any = specs.encoder
        if make is None:
            from hpamdp.policies.encoders.cnn import CNN  # it imports this module

            make = CNN
        self.entries = specs.entries
        encoders = {str(number): make(entry) for number, entry in enumerate(specs.entries) if entry.is_picture}
        self.encoders = nn.ModuleDict(encoders)
        num_features = sum(
            encoders[str(number)].num_features if str(number) in encoders else entry.size
            for number, entry in enumerate(specs.entries)
        )
        self.feature_specs = replace(
            specs,
            observation_dim=num_features,
            initial_weight=None,
            initial_bias=None,
            symmetries=None,
            geometry=None,
            entries=(),
            encoder=None,
        )

    def forward(self, observation: Tensor) -> Tensor:
        """Return features float32 `[*B, num_features]` of observations `[*B, observation_dim]`."""
        rows = observation.reshape(-1, observation.shape[-1])
        if torch.is_grad_enabled() or len(rows) <= _PIECE:
            features = self._features(rows)
        else:
            features = torch.cat([self._features(piece) for piece in rows.split(_PIECE)])
        return features.reshape(*observation.shape[:-1], features.shape[-1])

    def _features(self, rows: Tensor) -> Tensor:
        parts = []
        for number, entry in enumerate(self.entries):
            name = str(number)
            if name in self.encoders:
                parts.append(self.encoders[name](entry.picture(rows).to(torch.float32) / 255.0))
            else:
                parts.append(rows[:, entry.place].to(torch.float32))
        return parts[0] if len(parts) == 1 else torch.cat(parts, -1)
