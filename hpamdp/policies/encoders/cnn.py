"""Convolutional networks for pictures, with the sizes of Nature-DQN or of IMPALA.

Source: Mnih et al. 2015, *Human-level control through deep reinforcement learning*, section Methods (`nature`);
Espeholt et al. 2018, *IMPALA*, arXiv 1802.01561, figure 3, the deep network without its LSTM (`impala`).

Differs from the sources:
- weights are orthogonal at the start, as in the implementations of PPO;
- channels and features can be set. The defaults are those of the sources.

`nature` is TorchRL's ConvNet. TorchRL has no residual blocks, so `impala` is written out here.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.modules import ConvNet

from hpamdp.observation_entries import ObservationEntry
from hpamdp.policies.encoders.base import Encoder
from hpamdp.policies.encoders.options import CARDS, CNNOptions
from hpamdp.settings import SettingError

_NATURE_KERNELS = [8, 4, 3]
_NATURE_STRIDES = [4, 2, 1]
_NATURE_CHANNELS = (32, 64, 64)
_NATURE_FEATURES = 512
_NATURE_SMALLEST = 36  # px a side; of smaller pictures nothing is left for the last convolution

_IMPALA_CHANNELS = (16, 32, 32)
_IMPALA_FEATURES = 256


class CNN(Encoder):
    """A convolutional network and a linear layer with ReLU."""

    Options = CNNOptions
    card = CARDS["CNN"]

    def __init__(self, entry: ObservationEntry, *, options: CNNOptions | None = None, **settings: Any) -> None:
        super().__init__(entry)
        self.options = options = CNNOptions.of(options, settings)
        channels, height, width = entry.picture_shape
        is_small = min(height, width) < _NATURE_SMALLEST
        if options.net == "nature" and is_small:
            raise SettingError(
                f"net=nature: needs pictures of at least {_NATURE_SMALLEST} px a side, but {entry.name} has "
                f"{height} x {width}; use net=impala"
            )
        is_nature = options.net == "nature" or (options.net == "auto" and not is_small)
        if is_nature:
            # ConvNet has no argument for its dtype, so it is converted: torch's default dtype may be another one.
            net: nn.Module = ConvNet(
                channels,
                num_cells=list(options.channels or _NATURE_CHANNELS),
                kernel_sizes=_NATURE_KERNELS,
                strides=_NATURE_STRIDES,
                activation_class=nn.ReLU,
            ).float()
        else:
            net = _impala(channels, options.channels or _IMPALA_CHANNELS)
        with torch.no_grad():
            num_outputs = net(torch.zeros(1, *entry.picture_shape, dtype=torch.float32)).shape[-1]
        self.num_features = options.num_features or (_NATURE_FEATURES if is_nature else _IMPALA_FEATURES)
        linear = nn.Linear(num_outputs, self.num_features, dtype=torch.float32)
        self.net = nn.Sequential(net, linear, nn.ReLU())
        for layer in self.net.modules():
            if isinstance(layer, nn.Conv2d | nn.Linear) and layer.bias is not None:
                nn.init.orthogonal_(layer.weight, math.sqrt(2.0))
                nn.init.zeros_(layer.bias)

    def forward(self, values: Tensor) -> Tensor:
        """Return features `[B, num_features]` of pictures float32 `[B, C, H, W]`."""
        return self.net(values)


class ResidualBlock(nn.Module):
    """Two convolutions whose result is added to their input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1, dtype=torch.float32),
            nn.ReLU(),
            nn.Conv2d(channels, channels, 3, padding=1, dtype=torch.float32),
        )

    def forward(self, values: Tensor) -> Tensor:
        """Return `[B, channels, H, W]`."""
        return values + self.convolutions(values)


def _impala(in_channels: int, channels: tuple[int, ...]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for out_channels in channels:
        layers += [
            nn.Conv2d(in_channels, out_channels, 3, padding=1, dtype=torch.float32),
            nn.MaxPool2d(3, stride=2, padding=1),
            ResidualBlock(out_channels),
            ResidualBlock(out_channels),
        ]
        in_channels = out_channels
    return nn.Sequential(*layers, nn.ReLU(), nn.Flatten())
