"""Networks that several learners share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn


class EnsembleLinear(nn.Module):
    """`num_members` linear layers side by side: `[E, B, in]` -> `[E, B, out]` in one batched product."""

    def __init__(self, num_members: int, in_dim: int, out_dim: int) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(in_dim)  # as nn.Linear
        self.weight = nn.Parameter(torch.empty(num_members, in_dim, out_dim).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(num_members, 1, out_dim).uniform_(-bound, bound))

    def forward(self, x: Tensor) -> Tensor:
        """Apply every member to its own slice of `x`."""
        return torch.baddbmm(self.bias, x, self.weight)


class EnsembleMLP(nn.Module):
    """`num_members` independent ReLU networks on the same input `[B, in]`, output `[E, B, out]`.

    One batched product a layer costs about half of running the members one after the other on small batches.
    """

    def __init__(self, num_members: int, in_dim: int, hidden_dims: Sequence[int], out_dim: int) -> None:
        super().__init__()
        dims = [in_dim, *hidden_dims, out_dim]
        self.num_members = num_members
        self.layers = nn.ModuleList(EnsembleLinear(num_members, i, o) for i, o in pairwise(dims))

    def forward(self, x: Tensor) -> Tensor:
        """Apply all members."""
        x = x.expand(self.num_members, *x.shape)
        for layer in self.layers[:-1]:
            x = layer(x).relu()
        return self.layers[-1](x)


def mlp(in_dim: int, hidden_dims: Sequence[int], out_dim: int) -> nn.Sequential:
    """Return a ReLU network with linear output."""
    dims = [in_dim, *hidden_dims]
    layers: list[nn.Module] = []
    for i, o in pairwise(dims):
        layers += [nn.Linear(i, o), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(dims[-1], out_dim))
