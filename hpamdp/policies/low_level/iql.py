"""Implicit Q-learning: the value of the better actions in the data, and a policy that imitates these.

V(s) is an upper expectile of Q(s, k, x) over the actions in the data, Q is fitted to r + gamma V(s'), and the policy
maximises the log-likelihood of the data's actions, weighted by exp(temperature * (Q - V)). Q is never evaluated at an
action that is not in the data.

Source: Kostrikov, Nair and Levine 2021, *Offline Reinforcement Learning with Implicit Q-Learning*, arXiv 2110.06169,
equations 5 to 7.

Differs from the source: an action is a discrete action and its own parameters, so the policy is H-PPO's (Fan et al.
2019, arXiv 1903.01344) and Q sees the chosen action's own parameters alone, as in MP-DQN (Bester et al. 2019, arXiv
1905.04388).

TorchRL's IQLLoss does not fit: it reads a single action leaf.
"""

from __future__ import annotations

import copy
from typing import Annotated

import torch
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from hpamdp.policies.shared.gradients import expectile_loss
from hpamdp.policies.shared.hybrid_actor import HybridActor, HybridDistribution, HybridPolicy
from hpamdp.policies.shared.networks import HybridCritics, mlp, polyak_update
from hpamdp.policies.shared.replay import ReplayLearner, ReplayOptions
from hpamdp.settings import Expectile, LearningRate, PositiveFraction
from hpamdp.specs import PAMDPSpecs


class IQL(ReplayLearner):
    """Twin critics, a state value and an advantage-weighted policy, from a data set or a replay buffer."""

    stores_own_parameters = True

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        hidden_dims: Annotated[list[PositiveInt], Field(min_length=1)],
        min_scale: PositiveFloat,
        max_scale: PositiveFloat,
        expectile: Expectile,
        temperature: PositiveFloat,
        max_weight: PositiveFloat,
        gamma: PositiveFraction,
        tau: PositiveFraction,
        actor_lr: LearningRate,
        critic_lr: LearningRate,
        warmup_steps: NonNegativeInt,
        buffer_size: PositiveInt,
        batch_size: PositiveInt,
        updates_per_step: PositiveFloat,
        augment: bool,
    ) -> None:
        if not min_scale < max_scale:
            raise ValueError(f"min_scale={min_scale}: must be less than {max_scale=}")
        options = ReplayOptions(
            gamma=gamma,
            warmup_steps=warmup_steps,
            buffer_size=buffer_size,
            batch_size=batch_size,
            updates_per_step=updates_per_step,
            augment=augment,
        )
        super().__init__(specs, device, options)
        self.expectile = expectile
        self.temperature = temperature
        self.max_weight = max_weight
        self.tau = tau

        self.actor = HybridActor(specs, hidden_dims, (min_scale, max_scale), (min_scale * max_scale) ** 0.5)
        self.state_value = mlp(specs.observation_dim, hidden_dims, 1)
        self.critics = HybridCritics(specs, 2, hidden_dims, is_multipass=True)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = HybridPolicy(self.actor, specs)
        self.to(device)
        self.optimizers = {
            "actor": torch.optim.Adam(self.actor.parameters(), lr=actor_lr, fused=True),
            "state_value": torch.optim.Adam(self.state_value.parameters(), lr=critic_lr, fused=True),
            "critics": torch.optim.Adam(self.critics.parameters(), lr=critic_lr, fused=True),
        }

    def value(self, observation: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Return V(s), `[B]`."""
        return self.state_value(observation).squeeze(-1)

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update V, then Q, then the policy from transitions `[batch_size]`; return scalars."""
        with torch.no_grad():
            q = self.target_critics.of_discrete(sample["state"], sample["discrete"], sample["unit"]).amin(0)
        of_value = self.gradient_step("state_value", self._value_loss, sample["state"], q)
        scalars = self.gradient_step("critics", self._critic_loss, sample) | of_value | {"q": q.mean()}
        polyak_update(self.target_critics, self.critics, self.tau)
        return scalars | self.gradient_step("actor", self._actor_loss, sample, self.allowed(sample), q)

    def _value_loss(self, state: Tensor, q: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the distance of V from the expectile of the values `[B]` of the data's actions."""
        excess = q - self.value(state)
        loss = expectile_loss(excess, self.expectile)
        return loss, {"value": loss}

    def _critic_loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the squared distance from the targets."""
        q = self.critics.of_discrete(sample["state"], sample["discrete"], sample["unit"])
        loss = F.mse_loss(q, self.target(sample).expand_as(q))
        return loss, {"critic": loss}

    def _actor_loss(
        self, sample: TensorDictBase, allowed: Tensor | None, q: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the negative log-likelihood of the data's actions, weighted by their advantages."""
        with torch.no_grad():
            advantage = q - self.value(sample["state"])
            weight = (self.temperature * advantage).exp().clamp(max=self.max_weight)
        distribution: HybridDistribution = self.actor(sample["state"], allowed)
        discrete_log_prob, parameter_log_prob = distribution.log_prob(sample["discrete"], sample["unit"])
        loss = -(weight * (discrete_log_prob + parameter_log_prob)).mean()
        return loss, {"advantage_weight": weight.mean()}
