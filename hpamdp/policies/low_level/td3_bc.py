"""TD3+BC for parameterised actions: P-DQN restricted to the data's discrete actions, with parameters near the data's.

Source: Fujimoto and Gu 2021, *A Minimalist Approach to Offline Reinforcement Learning*, arXiv 2106.06860, equation 5,
on the critics of MP-DQN (Bester et al. 2019, arXiv 1905.04388) with the twin critics, smoothing and delay of TD3
(Fujimoto et al. 2018, arXiv 1802.09477). Which discrete actions are allowed: discrete BCQ (Fujimoto et al. 2019, arXiv
1910.01708, equation in section 4).

Differs from the sources:
- every discrete action has its own parameters, so the actor increases the values of all discrete actions, each weighted
  by its frequency in the data; the distance from the data is that of the recorded action's own parameters;
- the actor increases the minimum of both critics, not the first one's value;
- states are not normalised, as problems scale their observations;
- by default the values weigh twice as much: `behaviour_weight` is 1 / alpha, 0.2 where the source has alpha = 2.5, that
  is 0.4.

TorchRL's TD3BCLoss does not fit: its policy is a single bounded action leaf, without a discrete choice.
"""

from __future__ import annotations

import copy
from typing import Annotated

import torch
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.policies.base import is_greedy
from hpamdp.policies.masks import allowed_rows, masked_logits
from hpamdp.policies.shared.exploration import with_exploring_noise
from hpamdp.policies.shared.networks import HybridCritics, mlp, polyak_update, with_clipped_noise
from hpamdp.policies.shared.replay import ReplayLearner, ReplayOptions
from hpamdp.settings import LearningRate, PositiveFraction
from hpamdp.specs import PAMDPSpecs


class TD3BCPolicy(TensorDictModuleBase):
    """Takes the discrete action with the highest Q among the allowed ones; explores with noise on the parameters.

    A discrete action is allowed where the data takes it often enough.

    Args:
        actor: the parameters of all discrete actions, in [-1, 1].
        critics: the values of all discrete actions.
        behaviour: logits of the data's discrete actions.
        specs: sizes and bounds of the problem.
        discrete_threshold: least probability of an allowed action, as a fraction of the most frequent action's.
        parameter_noise: standard deviation of the exploration noise.
    """

    def __init__(
        self,
        actor: nn.Module,
        critics: HybridCritics,
        behaviour: nn.Module,
        specs: PAMDPSpecs,
        discrete_threshold: float,
        parameter_noise: float,
    ) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.actor = actor
        self.critics = critics
        self.behaviour = behaviour
        self.specs = specs
        self.log_threshold = (
            torch.tensor(discrete_threshold, dtype=torch.float32).log().item()
        )  # -inf where the threshold is 0
        self.parameter_noise = parameter_noise

    def is_refused(self, state: Tensor, allowed: Tensor | None) -> Tensor:
        """Return which discrete actions are forbidden or too rare in the data, bool `[B, num_discrete]`.

        Args:
            state: `[B, observation_dim]`.
            allowed: the discrete actions that may be taken, bool `[B, num_discrete]`; None: all.
        """
        log_probs = masked_logits(self.behaviour(state), allowed).log_softmax(-1)
        is_rare = log_probs < log_probs.amax(-1, keepdim=True) + self.log_threshold
        return is_rare if allowed is None else is_rare | ~allowed

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]` and the parameters `[*B, num_parameters]`."""
        state = td.get(keys.OBSERVATION).reshape(-1, self.specs.observation_dim)
        unit = self.actor(state)
        q = self.critics(state, unit).amin(0)
        discrete = q.masked_fill(self.is_refused(state, allowed_rows(self.specs, td)), -torch.inf).argmax(-1)
        if not is_greedy():
            unit = with_exploring_noise(unit, self.parameter_noise)
        td.set(keys.DISCRETE, discrete.reshape(td.batch_size))
        return td.set(keys.PARAMETERS, self.specs.from_unit(unit).reshape(*td.batch_size, -1))


class TD3BC(ReplayLearner):
    """Q-learning on the data's discrete actions with parameters near the data's, from a data set or a replay buffer."""

    stores_own_parameters = True

    policy: TD3BCPolicy

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        hidden_dims: list[PositiveInt],
        behaviour_weight: NonNegativeFloat,
        discrete_threshold: Annotated[float, Field(ge=0.0, lt=1.0)],
        target_smoothing: NonNegativeFloat,
        target_smoothing_clip: NonNegativeFloat,
        policy_delay: PositiveInt,
        parameter_noise: NonNegativeFloat,
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
        options = ReplayOptions(
            gamma=gamma,
            warmup_steps=warmup_steps,
            buffer_size=buffer_size,
            batch_size=batch_size,
            updates_per_step=updates_per_step,
            augment=augment,
        )
        super().__init__(specs, device, options)
        self.behaviour_weight = behaviour_weight
        self.target_smoothing = target_smoothing
        self.target_smoothing_clip = target_smoothing_clip
        self.policy_delay = policy_delay
        self.tau = tau

        self.actor = nn.Sequential(mlp(specs.observation_dim, hidden_dims, specs.num_parameters), nn.Tanh())
        self.critics = HybridCritics(specs, 2, hidden_dims, is_multipass=True)
        self.behaviour = mlp(specs.observation_dim, hidden_dims, specs.num_discrete)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = TD3BCPolicy(self.actor, self.critics, self.behaviour, specs, discrete_threshold, parameter_noise)
        self.to(device)
        self.optimizers = {
            "actor": torch.optim.Adam(self.actor.parameters(), lr=actor_lr, fused=True),
            "critics": torch.optim.Adam(self.critics.parameters(), lr=critic_lr, fused=True),
            "behaviour": torch.optim.Adam(self.behaviour.parameters(), lr=actor_lr, fused=True),
        }

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update critics and behaviour; every `policy_delay` updates, also actor and targets. Return scalars."""
        allowed = self.allowed(sample)
        scalars = self.gradient_step("critics", self._critic_loss, sample)
        scalars |= self.gradient_step("behaviour", self._behaviour_loss, sample, allowed)
        if self.updates % self.policy_delay == 0:
            scalars |= self.gradient_step("actor", self._actor_loss, sample, allowed)
            polyak_update(self.target_actor, self.actor, self.tau)
            polyak_update(self.target_critics, self.critics, self.tau)
        return scalars

    def _critic_loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the squared distance from the targets, and scalars."""
        q = self.critics.of_discrete(sample["state"], sample["discrete"], sample["unit"])
        loss = F.mse_loss(q, self.target(sample).expand_as(q))
        return loss, {"critic": loss, "q": q.mean()}

    def _behaviour_loss(self, sample: TensorDictBase, allowed: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the negative log-likelihood of the data's discrete actions."""
        loss = F.cross_entropy(masked_logits(self.behaviour(sample["state"]), allowed), sample["discrete"])
        return loss, {"behaviour": loss}

    def _actor_loss(self, sample: TensorDictBase, allowed: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss that falls towards higher values and towards the data."""
        state = sample["state"]
        unit = self.actor(state)
        with torch.no_grad():
            frequency = masked_logits(self.behaviour(state), allowed).softmax(-1)
        q = (self.critics(state, unit).amin(0) * frequency).sum(-1)
        is_own = self.owner == sample["discrete"].unsqueeze(-1)
        distance = ((unit - sample["unit"]).square() * is_own).sum(-1)
        # Values are divided by their mean size, so that the weight does not depend on the scale of the reward.
        loss = (self.behaviour_weight * distance).mean() - q.mean() / q.detach().abs().mean().clamp(min=1e-6)
        return loss, {"actor": loss}

    @torch.no_grad()
    def value(self, observation: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Return max_k Q'(s, k, x'(s)) over the allowed discrete actions k, `[B]`."""
        unit = with_clipped_noise(self.target_actor(observation), self.target_smoothing, self.target_smoothing_clip)
        q = self.target_critics(observation, unit).amin(0)
        is_refused = self.policy.is_refused(observation, self.specs.allowed(observation, action_mask))
        return q.masked_fill(is_refused, -torch.inf).amax(-1)
