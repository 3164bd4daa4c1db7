"""Fourier features of the observation for Q-PAMDP, and modules whose buffers get their sizes from data.

Source: Konidaris, Osentoski and Thomas 2011, *Value Function Approximation in Reinforcement Learning using the Fourier
Basis*; see `qpamdp.py`, also for what differs.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import torch
from torch import Tensor, nn


class SizedByData(nn.Module):
    """A module whose buffers get their sizes from data, and so from a checkpoint when it is loaded."""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        for name, buffer in list(self.named_buffers(recurse=False)):
            saved = state_dict.get(prefix + name)
            if saved is not None and saved.shape != buffer.shape:
                self.register_buffer(name, buffer.new_zeros(saved.shape))
        super()._load_from_state_dict(state_dict, prefix, *args)


def fourier_coefficients(num_inputs: int, order: int, max_coupled: int) -> Tensor:
    """Return the cosines' coefficients `[num_features, num_inputs]`: 0 to `order`, at most `max_coupled` not 0.

    The constant comes first.
    """
    rows = [
        [dict(zip(coupled, values, strict=True)).get(i, 0) for i in range(num_inputs)]
        for num_coupled in range(min(max_coupled, num_inputs) + 1)
        for coupled in itertools.combinations(range(num_inputs), num_coupled)
        for values in itertools.product(range(1, order + 1), repeat=num_coupled)
    ]
    return torch.tensor(rows, dtype=torch.float32)


class FourierBasis(SizedByData):
    """Cosine features cos(pi c.u) of the observation's chosen entries, scaled to u in [0, 1]; at first the constant."""

    def __init__(self, order: int, max_coupled: int) -> None:
        super().__init__()
        self.order, self.max_coupled = order, max_coupled
        self.register_buffer("inputs", torch.zeros(1, dtype=torch.long))
        self.register_buffer("low", torch.zeros(1))
        self.register_buffer("width", torch.ones(1))
        self.register_buffer("coefficients", torch.zeros(1, 1))

    def fit(self, inputs: Tensor, low: Tensor, high: Tensor) -> None:
        """Use the observation's entries `inputs` int64 `[d]`, which lie between `low` and `high` `[d]`."""
        self.inputs, self.low, self.width = inputs, low, (high - low).clamp(min=1e-6)
        self.coefficients = fourier_coefficients(len(inputs), self.order, self.max_coupled).to(low)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the features `[*B, num_features]` of observations `[*B, observation_dim]`."""
        unit = ((observation[..., self.inputs] - self.low) / self.width).clamp(0.0, 1.0)
        return (math.pi * unit @ self.coefficients.T).cos()
