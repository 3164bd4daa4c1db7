"""Define a custom learner: REINFORCE with a learned baseline, on the shared hybrid actor.

Source: Williams 1992, *Simple statistical gradient-following algorithms for connectionist reinforcement learning*.
"""

from __future__ import annotations

from typing import Any

import torch
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import Learner, option_ends
from hpamdp.policies.shared.hybrid_actor import HybridActor
from hpamdp.policies.shared.networks import mlp
from hpamdp.settings import PositiveFraction
from hpamdp.specs import PAMDPSpecs

RAW = "raw_parameters"  # the parameters as they were sampled, before they are clipped to their bounds


class ReinforcePolicy(TensorDictModuleBase):
    """Sample from the actor, or take its mode if greedy."""

    def __init__(self, actor: HybridActor, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, RAW]
        self.actor = actor
        self.specs = specs

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]`, its parameters and their raw sample `[*B, num_parameters]`."""
        distribution = self.actor(td.get(keys.OBSERVATION))
        discrete, raw = distribution.mode() if is_greedy() else distribution.sample()
        parameters = self.specs.from_unit(raw.clamp(-1.0, 1.0))
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": parameters}, RAW: raw})


class Reinforce(Learner):
    """Make one gradient step per batch on the actions' log-likelihood, weighted by the return less a baseline."""

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        hidden_dims: list[PositiveInt],
        gamma: PositiveFraction,
        lr: PositiveFloat,
        entropy: NonNegativeFloat,
    ) -> None:
        super().__init__(specs)
        self.gamma = gamma
        self.entropy = entropy
        self.actor = HybridActor(specs, hidden_dims, scale_range=(0.02, 1.0), initial_scale=0.5)
        self.baseline = mlp(specs.observation_dim, hidden_dims, 1)
        self.policy = ReinforcePolicy(self.actor, specs)
        self.to(device)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr)

    def stateful(self) -> dict[str, Any]:
        """Return the optimizer, which a checkpoint saves beside the networks."""
        return {"optimizer": self.optimizer}

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Make one step from the rows of `mask` `[*B, T]`. Unfinished episodes bootstrap from the baseline."""
        if not mask.any():
            return {}
        returns = self.returns(batch)[mask]
        rows = batch[mask]
        value = self.baseline(rows[keys.OBSERVATION]).squeeze(-1)
        advantage = (returns - value).detach()
        advantage = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-6)
        distribution = self.actor(rows[keys.OBSERVATION])
        of_discrete, of_parameters = distribution.log_prob(rows[keys.DISCRETE], rows[RAW])
        entropy = sum(part.mean() for part in distribution.entropy())
        gain = ((of_discrete + of_parameters) * advantage).mean()
        baseline_loss = (value - returns).square().mean()
        self.optimizer.zero_grad()
        (baseline_loss - gain - self.entropy * entropy).backward()
        self.optimizer.step()
        return {"baseline": baseline_loss.item(), "entropy": entropy.item()}

    @torch.no_grad()
    def returns(self, batch: TensorDictBase) -> Tensor:
        """Return the discounted return from every step of a batch, `[*B, T]`."""
        reward = batch["next", keys.REWARD].squeeze(-1)
        is_end = option_ends(batch).squeeze(-1)
        terminated = batch["next", keys.TERMINATED].squeeze(-1)
        following = self.baseline(batch["next", keys.OBSERVATION]).squeeze(-1) * ~terminated
        returns = torch.zeros_like(reward)
        ahead = following[..., -1]
        for t in reversed(range(reward.shape[-1])):
            ahead = reward[..., t] + self.gamma * torch.where(is_end[..., t], following[..., t], ahead)
            returns[..., t] = ahead
        return returns
