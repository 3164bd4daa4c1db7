"""Fourier features of the observation for Q-PAMDP.

Source: Konidaris, Osentoski and Thomas 2011, *Value Function Approximation in Reinforcement Learning using the Fourier
Basis*; see `qpamdp.py`, also for the differences from the source.
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor, nn

from hpamdp.policies.shared.sized_by_data import SizedByData


def fourier_coefficients(num_inputs: int, order: int, max_coupled: int) -> Tensor:
    """Return the coefficients of the cosines, `[num_features, num_inputs]`.

    They are all vectors of integers from 0 to `order` of which at most `max_coupled` are not 0. The constant (all 0)
    comes first.
    """
    rows: list[list[int]] = []
    for num_coupled in range(min(max_coupled, num_inputs) + 1):
        for coupled in itertools.combinations(range(num_inputs), num_coupled):
            for values in itertools.product(range(1, order + 1), repeat=num_coupled):
                row = [0] * num_inputs
                for i, value in zip(coupled, values, strict=True):
                    row[i] = value
                rows.append(row)
    return torch.tensor(rows, dtype=torch.float32)


def num_fourier_features(num_inputs: int, order: int, max_coupled: int) -> int:
    """Return how many rows `fourier_coefficients` has."""
    return sum(math.comb(num_inputs, coupled) * order**coupled for coupled in range(min(max_coupled, num_inputs) + 1))


class FourierBasis(SizedByData):
    """Cosine features cos(pi c.u) of some entries of the observation, scaled to u in [0, 1].

    Until `fit` is called, the only feature is the constant 1.

    Args:
        order: largest coefficient.
        max_coupled: largest number of entries that a feature depends on.
    """

    def __init__(self, order: int, max_coupled: int) -> None:
        super().__init__()
        self.order = order
        self.max_coupled = max_coupled
        self.inputs: Tensor = nn.Buffer(torch.zeros(1, dtype=torch.long))
        self.low: Tensor = nn.Buffer(torch.zeros(1, dtype=torch.float32))
        self.width: Tensor = nn.Buffer(torch.ones(1, dtype=torch.float32))
        self.coefficients: Tensor = nn.Buffer(torch.zeros(1, 1, dtype=torch.float32))

    def fit(self, inputs: Tensor, low: Tensor, high: Tensor) -> None:
        """Set the entries of the observation to use and their ranges.

        Args:
            inputs: indices of the entries, int64 `[d]`.
            low, high: their bounds, `[d]`; values outside are clipped.
        """
        self.inputs = inputs
        self.low = low
        self.width = (high - low).clamp(min=1e-6)
        self.coefficients = fourier_coefficients(len(inputs), self.order, self.max_coupled).to(low)

    def step_scale(self) -> Tensor:
        """Return the factor 1 / ||c|| on the step of each feature's weight, 1 for the constant, `[num_features]`.

        Source: Konidaris, Osentoski and Thomas 2011, section 4.
        """
        norm = self.coefficients.norm(dim=-1)
        return 1.0 / torch.where(norm > 0.0, norm, 1.0)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the features `[*B, num_features]` of observations `[*B, observation_dim]`."""
        scaled = ((observation[..., self.inputs] - self.low) / self.width).clamp(0.0, 1.0)
        return (math.pi * scaled @ self.coefficients.T).cos()
