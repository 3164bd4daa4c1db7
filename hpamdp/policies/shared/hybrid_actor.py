"""A hybrid stochastic policy's network: a categorical over the keys and a Gaussian for their parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.policies.base import is_greedy
from hpamdp.policies.shared.networks import sample_index
from hpamdp.specs import PAMDPSpecs


class HybridDistribution(NamedTuple):
    """A categorical over keys and a Gaussian for each of their parameters.

    Shapes: log-probabilities of the keys `[*B, num_keys]`, mean and log-deviation `[*B, num_parameters]`, the mask of
    each key's own parameters `[num_keys, num_parameters]`.
    """

    discrete_log_probs: Tensor
    mean: Tensor
    log_scale: Tensor
    parameter_mask: Tensor

    def sample(self) -> tuple[Tensor, Tensor]:
        """Draw keys `[*B]` and unbounded parameters `[*B, num_parameters]`, those of the other keys too."""
        return sample_index(self.discrete_log_probs), self.mean + self.log_scale.exp() * torch.randn_like(self.mean)

    def mode(self) -> tuple[Tensor, Tensor]:
        """Return the likeliest key `[*B]` and the mean parameters `[*B, num_parameters]`."""
        return self.discrete_log_probs.argmax(-1), self.mean

    def log_prob(self, discrete: Tensor, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Return the log-likelihoods `[*B]` of the key and of its own parameters, 0 where it has none."""
        normal = (
            -0.5 * ((raw - self.mean) / self.log_scale.exp()).square() - self.log_scale - 0.5 * math.log(2 * math.pi)
        )
        of_discrete = self.discrete_log_probs.gather(-1, discrete.unsqueeze(-1)).squeeze(-1)
        return of_discrete, (normal * self.parameter_mask[discrete]).sum(-1)

    def entropy(self) -> tuple[Tensor, Tensor]:
        """Return the entropies `[*B]` of the key and, in the mean over keys, of a key's own parameters."""
        probability = self.discrete_log_probs.exp()
        normal = self.log_scale + 0.5 * math.log(2 * math.pi * math.e)
        return -(probability * self.discrete_log_probs).sum(-1), ((probability @ self.parameter_mask) * normal).sum(-1)


class HybridActor(nn.Module):
    """The discrete and the continuous actor on one encoder."""

    def __init__(
        self, specs: PAMDPSpecs, hidden_dims: Sequence[int], scale_range: tuple[float, float], initial_scale: float
    ) -> None:
        super().__init__()
        self.encoder = encoder(specs.observation_dim, hidden_dims)
        self.discrete_head = nn.Linear(hidden_dims[-1], specs.num_discrete)
        self.parameter_head = nn.Linear(hidden_dims[-1], 2 * specs.num_parameters)
        low, high = (math.log(scale) for scale in scale_range)
        self.register_buffer("log_min_scale", torch.tensor(low))
        self.log_max_scale = high
        share = (math.log(initial_scale) - low) / (high - low)
        with torch.no_grad():
            # Near-uniform keys and mid-range means to begin with.
            for head in (self.discrete_head, self.parameter_head):
                head.weight.mul_(0.01)
                head.bias.zero_()
            self.parameter_head.bias[specs.num_parameters :] = math.log(share / (1.0 - share))
        self.register_buffer("parameter_mask", specs.parameter_mask.float())

    def forward(self, observation: Tensor) -> HybridDistribution:
        """Return the distribution of the next press for observations `[*B, observation_dim]`."""
        hidden = self.encoder(observation)
        mean, raw_scale = self.parameter_head(hidden).chunk(2, -1)
        log_scale = self.log_min_scale + (self.log_max_scale - self.log_min_scale) * raw_scale.sigmoid()
        return HybridDistribution(self.discrete_head(hidden).log_softmax(-1), mean, log_scale, self.parameter_mask)

    def set_min_scale(self, min_scale: float) -> None:
        """Move the lower end of the range in which the Gaussian's deviation is learned."""
        self.log_min_scale.fill_(math.log(min_scale))


class HybridPolicy(TensorDictModuleBase):
    """Draws the press from the actor, or takes its likeliest one when greedy."""

    def __init__(self, actor: HybridActor, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [keys.OBSERVATION], [keys.DISCRETE, keys.PARAMETERS]
        self.actor, self.specs = actor, specs

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write key `[*B]` and parameters `[*B, num_parameters]`."""
        distribution = self.actor(td.get(keys.OBSERVATION))
        discrete, raw = distribution.mode() if is_greedy() else distribution.sample()
        return td.update(
            {keys.ACTION: {"discrete": discrete, "parameters": self.specs.from_unit(raw.clamp(-1.0, 1.0))}}
        )


def encoder(in_dim: int, hidden_dims: Sequence[int]) -> nn.Sequential:
    """Return the ReLU layers below the heads, orthogonal to begin with."""
    layers: list[nn.Module] = []
    for i, o in zip([in_dim, *hidden_dims], hidden_dims, strict=False):
        linear = nn.Linear(i, o)
        nn.init.orthogonal_(linear.weight, math.sqrt(2.0))
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers)
