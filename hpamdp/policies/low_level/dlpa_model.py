"""DLPA's learned model of a problem with parameterised actions: transition, rewards and termination.

Source: Zhang, Fu, Miao and Konidaris, 2024, arXiv 2404.03037, section 4; see `dlpa.py`, also for what differs.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp.policies.shared.networks import EnsembleMLP
from hpamdp.specs import PAMDPSpecs


class Predictor(nn.Module):
    """`num_members` independent networks of (s, k, x_k), output `[E, B, out_dim]`.

    `parallel` sees state, one-hot key and the key's own parameters at once, `masking` all parameters with the other
    keys' set to 0, `sequential` state and key first and what comes of them with the own parameters.
    Shapes: states `[B, observation_dim]`, keys `[B]`, parameters `[B, num_parameters]` in [-1, 1].
    """

    def __init__(self, specs: PAMDPSpecs, form: str, num_members: int, hidden_dims: list[int], out_dim: int) -> None:
        super().__init__()
        self.form = form
        width = max(specs.parameter_dims)
        first_dim = specs.observation_dim + specs.num_discrete
        slot_dim = specs.num_parameters if form == "masking" else width
        self.first = nn.Linear(first_dim, hidden_dims[0]) if form == "sequential" else None
        in_dim = hidden_dims[0] if form == "sequential" else first_dim
        self.net = EnsembleMLP(num_members, in_dim + slot_dim, hidden_dims, out_dim)
        mask = specs.parameter_mask
        # Where each key's own parameters lie, moved to the front; 0 parameters of other keys fill the rest.
        self.register_buffer("mask", mask.float())
        self.register_buffer("slots", (~mask).to(torch.int8).argsort(dim=-1, stable=True)[:, :width])

    def forward(self, state: Tensor, discrete: Tensor, unit: Tensor) -> Tensor:
        """Apply all members."""
        own = unit * self.mask[discrete]
        if self.form != "masking":
            own = own.gather(-1, self.slots[discrete])
        x = torch.cat([state, F.one_hot(discrete, self.mask.shape[0]).to(state.dtype)], -1)
        if self.first is not None:
            x = self.first(x).relu()
        return self.net(torch.cat([x, own], -1))


class Prediction(NamedTuple):
    """What the model says of a press."""

    next_state: Tensor  # [B, observation_dim], if the press does not terminate
    continuing: Tensor  # [E, B] reward if it does not
    terminating: Tensor  # [E, B] reward if it does
    logit: Tensor  # [E, B] of termination


class PAMDPModel(nn.Module):
    """Transition, reward and termination predictors; `[E]` members for all but the transition."""

    def __init__(self, specs: PAMDPSpecs, form: str, hidden_dims: list[int], num_members: int) -> None:
        super().__init__()
        self.transition = Predictor(specs, form, 1, hidden_dims, specs.observation_dim)
        self.outcome = Predictor(specs, form, num_members, hidden_dims, 3)
        self.register_buffer("state_mean", torch.zeros(specs.observation_dim))
        self.register_buffer("state_scale", torch.ones(specs.observation_dim))
        self.register_buffer("change_scale", torch.ones(specs.observation_dim))

    def fit_scales(self, state: Tensor, next_state: Tensor) -> None:
        """Take the scales of inputs and targets from transitions `[B, observation_dim]`."""
        # Entries that never change keep a scale that makes them weigh nothing.
        self.state_mean.copy_(state.mean(0))
        self.state_scale.copy_(state.std(0).clamp(min=1e-2))
        self.change_scale.copy_((next_state - state).std(0).clamp(min=1e-2))

    def forward(self, state: Tensor, discrete: Tensor, unit: Tensor) -> Prediction:
        """Predict one press from states `[B, observation_dim]`, keys `[B]`, parameters `[B, num_parameters]`."""
        scaled = (state - self.state_mean) / self.state_scale
        change = self.transition(scaled, discrete, unit)[0] * self.change_scale
        return Prediction(state + change, *self.outcome(scaled, discrete, unit).unbind(-1))
