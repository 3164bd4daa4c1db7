"""Credit for each component of an action: a critic estimates what each component contributed to the return.

Source: Flavin and Sen 2026, *Revisiting Action Factorization for Complex Action Spaces*, arXiv 2606.26574 (a branching
critic for PPO whose branches are summed, VDN-PPO, or mixed, PPO-MIX). Sum: Sunehag et al. 2018, arXiv 1706.05296.
Monotonic mixing: Rashid et al. 2018, *QMIX*, arXiv 1803.11485, section 4.

Differs from the source: what the other components contributed is subtracted from the advantage as a baseline (Wu et al.
2018, *Variance Reduction for Policy Gradient with Action-Dependent Factorized Baselines*, arXiv 1803.07246). So errors
of this critic add variance, but no bias. The mixed total is 0 if all contributions are 0; QMIX adds a value of the
state.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp.policies.shared.hybrid_distribution import HybridDistribution
from hpamdp.policies.shared.networks import HybridCritics, OutputLinear, in_float32
from hpamdp.policies.shared.options import Credit
from hpamdp.specs import PAMDPSpecs

_MIXING_UNITS = 32


class CreditCritic(nn.Module):
    """Splits the advantage of an action into contributions of its components, given the state.

    A contribution is the value of what the component chose, minus its expectation under the policy.

    Args:
        specs: of what the networks see.
        hidden_dims: hidden layers of the branches.
        credit: `summed`, or `mixed` by a network that is monotonic in each contribution.
    """

    def __init__(self, specs: PAMDPSpecs, hidden_dims: Sequence[int], credit: Credit) -> None:
        super().__init__()
        self.components = specs.components
        self.branches = HybridCritics(specs, 1, hidden_dims, is_multipass=True)
        self.is_mixed = credit == "mixed"
        if self.is_mixed:
            num = len(self.components.sizes)
            # Weights and bias of the mixing network's hidden layer, and weights of its output.
            self.sizes = [num * _MIXING_UNITS, _MIXING_UNITS, _MIXING_UNITS]
            self.hyper = OutputLinear(specs.observation_dim, sum(self.sizes), dtype=torch.float32)

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
        """Return the advantages `[B]`, given contributions `[B, num_components]`; 0 if all of these are 0."""
        if not self.is_mixed:
            return contributions.sum(-1)
        weight, bias, out_weight = self.hyper(features).split(self.sizes, -1)
        weight = weight.abs().unflatten(-1, (contributions.shape[-1], _MIXING_UNITS))
        mixed = in_float32(lambda each: torch.einsum("bc,bch->bh", each, weight), contributions)
        hidden = F.elu(mixed + bias) - F.elu(bias)
        return (hidden * out_weight.abs()).sum(-1)

    def loss(
        self, features: Tensor, distribution: HybridDistribution, discrete: Tensor, raw: Tensor, advantage: Tensor
    ) -> Tensor:
        """Return the squared error of the advantages `[B]`; for the other arguments see `contributions`."""
        contributions = self.contributions(features, distribution, discrete, raw)
        return (self.total(features, contributions) - advantage).square().mean()

    def baselines(self, features: Tensor, distribution: HybridDistribution, discrete: Tensor, raw: Tensor) -> Tensor:
        """Return for each component the advantage of the others' contributions alone, `[B, num_components]`.

        Arguments are those of `contributions`.
        """
        contributions = self.contributions(features, distribution, discrete, raw)
        num = contributions.shape[-1]
        is_other = 1.0 - torch.eye(num, device=contributions.device, dtype=torch.float32)
        of_others = contributions.unsqueeze(1) * is_other
        repeated = features.unsqueeze(1).expand(-1, num, -1)
        return self.total(repeated.flatten(0, 1), of_others.flatten(0, 1)).unflatten(0, (-1, num))
