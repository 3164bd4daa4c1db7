"""Credit for each component of an action: a critic that says what each of them contributed to the return.

Source: Flavin and Sen 2026, *Revisiting Action Factorization for Complex Action Spaces*, arXiv 2606.26574 (a branching
critic for PPO whose branches are summed, VDN-PPO, or mixed, PPO-MIX). Sum: Sunehag et al. 2018, arXiv 1706.05296.
Monotonic mixing: Rashid et al. 2018, *QMIX*, arXiv 1803.11485, section 4.

Differs from the source: what the other components contributed is subtracted from the advantage as a baseline (Wu et al.
2018, *Variance Reduction for Policy Gradient with Action-Dependent Factorized Baselines*, arXiv 1803.07246). So errors
of this critic add variance, and no bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp.policies.shared.hybrid_distribution import HybridDistribution
from hpamdp.policies.shared.networks import HybridCritics
from hpamdp.specs import PAMDPSpecs

# How components share the credit: all get the whole advantage, or the critic's branches are summed or mixed.
Credit = Literal["joint", "summed", "mixed"]

_MIXING_UNITS = 32


class CreditCritic(nn.Module):
    """Splits the advantage of an action into contributions of its components, given the state.

    A contribution is the value of what the component chose, minus its expectation under the policy.

    Args:
        specs: of what the networks see.
        hidden_dims: hidden layers of the branches.
        credit: `summed` or `mixed`; mixed by a network that increases with each contribution.
    """

    def __init__(self, specs: PAMDPSpecs, hidden_dims: Sequence[int], credit: Credit) -> None:
        super().__init__()
        self.components = specs.components
        self.branches = HybridCritics(specs, 1, hidden_dims, is_multipass=True)
        self.is_mixed = credit == "mixed"
        if self.is_mixed:
            num = len(self.components.sizes)
            self.sizes = [num * _MIXING_UNITS, _MIXING_UNITS, _MIXING_UNITS]
            self.hyper = nn.Linear(specs.observation_dim, sum(self.sizes), dtype=torch.float32)

    def contributions(
        self, features: Tensor, distribution: HybridDistribution, discrete: Tensor, raw: Tensor
    ) -> Tensor:
        """Return the components' contributions `[B, num_components]`.

        Args:
            features: of the states, `[B, observation_dim]`.
            distribution: of the actions there; it gets no gradient.
            discrete: what the components chose, `[B, num_components]`.
            raw: raw parameters, `[B, num_parameters]`.
        """
        q = self.branches(features, raw.clamp(-1.0, 1.0))[0]
        expected = self.branches(features, distribution.mean.detach().clamp(-1.0, 1.0))[0]
        expected = expected * distribution.discrete_log_probs.detach().exp()
        by_component = torch.stack([part.sum(-1) for part in expected.split(self.components.sizes, -1)], -1)
        return self.components.of_choice(q, discrete) - by_component

    def total(self, features: Tensor, contributions: Tensor) -> Tensor:
        """Return the advantages `[B]` that contributions `[B, num_components]` make together."""
        if not self.is_mixed:
            return contributions.sum(-1)
        weight, bias, last = self.hyper(features).split(self.sizes, -1)
        weight = weight.abs().unflatten(-1, (contributions.shape[-1], _MIXING_UNITS))
        hidden = F.elu(torch.einsum("bc,bch->bh", contributions, weight) + bias) - F.elu(bias)
        return (hidden * last.abs()).sum(-1)

    def baselines(self, features: Tensor, contributions: Tensor) -> Tensor:
        """Return for each component what the others contributed without it, `[B, num_components]`."""
        num = contributions.shape[-1]
        without = contributions.unsqueeze(1) * (1.0 - torch.eye(num, device=contributions.device, dtype=torch.float32))
        repeated = features.unsqueeze(1).expand(-1, num, -1)
        return self.total(repeated.flatten(0, 1), without.flatten(0, 1)).unflatten(0, (-1, num))
