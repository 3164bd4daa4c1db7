"""Define a custom encoder: the mean colours of areas of a picture, and a linear layer."""

from __future__ import annotations

from typing import Any

from pydantic import PositiveInt
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp.observation_entries import ObservationEntry
from hpamdp.policies.encoders.base import Encoder
from hpamdp.settings import Settings


class AreasOptions(Settings):
    """Settings of `Areas`."""

    side: PositiveInt = 16
    """Number of areas from left to right, and from top to bottom."""
    num_features: PositiveInt = 64
    """Number of features."""


class Areas(Encoder):
    """Average a picture over areas, and learn linear features of the averages."""

    Options = AreasOptions

    def __init__(self, entry: ObservationEntry, *, options: AreasOptions | None = None, **settings: Any) -> None:
        super().__init__(entry)
        self.options: AreasOptions = AreasOptions.of(options, settings)
        self.num_features = self.options.num_features
        channels = entry.picture_shape[0]
        self.linear = nn.Linear(channels * self.options.side**2, self.num_features)

    def forward(self, values: Tensor) -> Tensor:
        """Return features `[B, num_features]` of pictures `[B, C, H, W]` in [0, 1]."""
        return F.relu(self.linear(F.adaptive_avg_pool2d(values, self.options.side).flatten(1)))
