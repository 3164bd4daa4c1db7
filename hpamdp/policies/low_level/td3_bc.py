"""TD3+BC for parameterised actions: P-DQN whose parameters stay near the data's, and whose keys the data holds.

Source: Fujimoto and Gu 2021, *A Minimalist Approach to Offline Reinforcement Learning*, arXiv 2106.06860, equation 5,
on the critics of MP-DQN (Bester et al. 2019, arXiv 1905.04388) with the twins, smoothing and delay of TD3 (Fujimoto et
al. 2018, arXiv 1802.09477). Which keys count as in the data: discrete BCQ (Fujimoto et al. 2019, arXiv 1910.01708,
equation in section 4).

Differs from the sources: every key has its parameters, so the actor ascends the keys' values in proportion to how often
the data presses them, and is held to the data at the pressed key alone.
"""

from __future__ import annotations

import copy
from typing import Annotated, ClassVar

import torch
from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.policies.base import is_greedy
from hpamdp.policies.shared.fractions import PositiveFraction
from hpamdp.policies.shared.networks import HybridCritics, mlp, polyak_update
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.specs import PAMDPSpecs


class TD3BCPolicy(TensorDictModuleBase):
    """Of the keys that the data presses in such a state, that of the highest Q; explores with noise on parameters."""

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
        self.in_keys, self.out_keys = [keys.OBSERVATION], [keys.DISCRETE, keys.PARAMETERS]
        self.actor, self.critics, self.behaviour, self.specs = actor, critics, behaviour, specs
        self.log_threshold, self.parameter_noise = torch.tensor(discrete_threshold).log().item(), parameter_noise

    def is_rare(self, state: Tensor) -> Tensor:
        """Return which keys the data presses too seldom in states `[B, observation_dim]`, bool `[B, num_keys]`."""
        log_probs = self.behaviour(state).log_softmax(-1)
        return log_probs < log_probs.amax(-1, keepdim=True) + self.log_threshold

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write key `[*B]` and parameters `[*B, num_parameters]`."""
        state = td.get(keys.OBSERVATION).reshape(-1, self.specs.observation_dim)
        unit = self.actor(state)
        q = self.critics(state, unit).amin(0)
        discrete = q.masked_fill(self.is_rare(state), -torch.inf).argmax(-1)
        if not is_greedy():
            unit = (unit + self.parameter_noise * torch.randn_like(unit)).clamp(-1.0, 1.0)
        td.set(keys.DISCRETE, discrete.reshape(td.batch_size))
        return td.set(keys.PARAMETERS, self.specs.from_unit(unit).reshape(*td.batch_size, -1))


class TD3BC(ReplayLearner):
    """Q-learning on keys of the data with parameters near the data's, from a data set or a replay buffer."""

    has_value: ClassVar[bool] = True

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
        actor_lr: PositiveFloat,
        critic_lr: PositiveFloat,
        warmup_frames: NonNegativeInt,
        buffer_size: PositiveInt,
        batch_size: PositiveInt,
        updates_per_frame: PositiveFloat,
    ) -> None:
        super().__init__(
            specs,
            device,
            gamma=gamma,
            warmup_frames=warmup_frames,
            buffer_size=buffer_size,
            batch_size=batch_size,
            updates_per_frame=updates_per_frame,
        )
        self.behaviour_weight, self.policy_delay, self.tau = behaviour_weight, policy_delay, tau
        self.target_smoothing, self.target_smoothing_clip = target_smoothing, target_smoothing_clip
        self.actor = nn.Sequential(mlp(specs.observation_dim, hidden_dims, specs.num_parameters), nn.Tanh())
        self.critics = HybridCritics(specs, 2, hidden_dims, is_multipass=True)
        self.behaviour = mlp(specs.observation_dim, hidden_dims, specs.num_discrete)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = TD3BCPolicy(self.actor, self.critics, self.behaviour, specs, discrete_threshold, parameter_noise)
        self.register_buffer("parameter_mask", specs.parameter_mask.float())
        self.to(device)
        self.optimizers = {
            "actor": torch.optim.Adam(self.actor.parameters(), lr=actor_lr, fused=True),
            "critics": torch.optim.Adam(self.critics.parameters(), lr=critic_lr, fused=True),
            "behaviour": torch.optim.Adam(self.behaviour.parameters(), lr=actor_lr, fused=True),
        }

    def value(self, observation: Tensor) -> Tensor:
        """Return the highest Q of the data's keys at the actor's parameters, `[B]`."""
        q = self.critics(observation, self.actor(observation)).amin(0)
        return q.masked_fill(self.policy.is_rare(observation), -torch.inf).amax(-1)

    def train_step(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update critics and keys' frequencies, now and then also the actor and the targets."""
        state, discrete, unit = sample["state"], sample["discrete"], sample["unit"]
        q = self.critics.of_discrete(state, discrete, unit)
        critic_loss = F.mse_loss(q, self._target(sample).expand_as(q))
        self.optimizer_step("critics", critic_loss)
        behaviour_loss = F.cross_entropy(self.behaviour(state), discrete)
        self.optimizer_step("behaviour", behaviour_loss)
        scalars = {"critic": critic_loss, "q": q.mean(), "behaviour": behaviour_loss}
        if self.updates % self.policy_delay == 0:
            scalars["actor"] = self._update_actor(state, discrete, unit)
            polyak_update(self.target_actor, self.actor, self.tau)
            polyak_update(self.target_critics, self.critics, self.tau)
        return scalars

    def _update_actor(self, state: Tensor, discrete: Tensor, unit: Tensor) -> Tensor:
        """Let the parameters ascend the values of the data's keys and stay near the data; return the loss."""
        own = self.actor(state)
        self.critics.requires_grad_(False)
        with torch.no_grad():
            frequency = self.behaviour(state).softmax(-1)
        q = (self.critics(state, own).amin(0) * frequency).sum(-1)
        distance = ((own - unit).square() * self.parameter_mask[discrete]).sum(-1)
        # The values in units of their own size, so that the weight means the same whatever the reward's scale.
        loss = (self.behaviour_weight * distance).mean() - q.mean() / q.detach().abs().mean().clamp(min=1e-6)
        self.optimizer_step("actor", loss)
        self.critics.requires_grad_(True)
        return loss

    @torch.no_grad()
    def _target(self, sample: TensorDictBase) -> Tensor:
        """Return r + discount max_k Q'(s', k, x'(s')) over the data's keys, `[B]`."""
        state = sample["next_state"]
        unit = self.target_actor(state)
        bound = self.target_smoothing_clip
        noise = (self.target_smoothing * torch.randn_like(unit)).clamp(-bound, bound)
        q = self.target_critics(state, (unit + noise).clamp(-1.0, 1.0)).amin(0)
        return sample["reward"] + sample["discount"] * q.masked_fill(self.policy.is_rare(state), -torch.inf).amax(-1)
