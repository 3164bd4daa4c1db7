"""HyAR: act in a learned latent space of discrete actions and their parameters.

An embedding table and a conditional VAE make key and parameters one continuous latent action (e, z); TD3 acts there.

Source: Li, Tang, Zheng, Hao, Li, Wang, Meng and Wang, *HyAR: Addressing Discrete-Continuous Action Reinforcement
Learning via Hybrid Action Representation*, 2022, arXiv 2109.05490: equations 2 to 6 and algorithm 1; TD3: Fujimoto, van
Hoof and Meger 2018, arXiv 1802.09477.

Differs from the source:
- parameters of different sizes lie side by side; the encoder sees only the pressed key's own, the decoder is trained on
  those alone;
- the state change is predicted in units of its own standard deviation over the warm-up data, so that no entry's scale
  swamps the reconstruction;
- random warm-up and epsilon-random presses have no latent of their own: they are encoded when they are sampled, which
  is what the representation-shift correction does for outdated ones.
"""

from __future__ import annotations

import copy
from typing import ClassVar

import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.policies.base import is_greedy
from hpamdp.policies.shared.fractions import Fraction, PositiveFraction
from hpamdp.policies.shared.networks import EnsembleMLP, mlp, polyak_update
from hpamdp.policies.shared.replay import ReplayLearner, linear_schedule
from hpamdp.specs import PAMDPSpecs

LATENT = "latent"  # the latent action as the actor gave it; NaN where the press was random


class HybridCodec(nn.Module):
    """The embedding table and the conditional VAE with its dynamics head.

    Shapes: states `[B, observation_dim]`, keys `[B]`, parameters `[B, num_parameters]` in [-1, 1], e `[B, embedding_dim]`,
    z `[B, latent_dim]`.
    """

    def __init__(self, specs: PAMDPSpecs, embedding_dim: int, latent_dim: int, hidden_dim: int) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        condition_dim = specs.observation_dim + embedding_dim
        self.table = nn.Parameter(torch.empty(specs.num_discrete, embedding_dim).uniform_(-1.0, 1.0))
        self.encoder = mlp(specs.num_parameters + condition_dim, [hidden_dim, hidden_dim], 2 * latent_dim)
        self.decoder = nn.Sequential(mlp(latent_dim + condition_dim, [hidden_dim], hidden_dim), nn.ReLU())
        self.parameter_head = nn.Linear(hidden_dim, specs.num_parameters)
        self.dynamics_head = mlp(hidden_dim, [hidden_dim], specs.observation_dim)
        self.register_buffer("mask", specs.parameter_mask.float())
        self.register_buffer("change_scale", torch.ones(specs.observation_dim))
        # The central range of encoded z, onto which the actor's [-1, 1] is mapped.
        self.register_buffer("z_low", -torch.ones(latent_dim))
        self.register_buffer("z_high", torch.ones(latent_dim))

    @property
    def embeddings(self) -> Tensor:
        """The table's rows, bounded to (-1, 1)."""
        return self.table.tanh()

    def nearest_discrete(self, e: Tensor) -> Tensor:
        """Return the key `[B]` whose embedding lies nearest to e."""
        return torch.cdist(e, self.embeddings).argmin(-1)

    def encode(self, state: Tensor, discrete: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean and log-variance of z, each `[B, latent_dim]`."""
        own = parameters * self.mask[discrete]
        mean, log_variance = self.encoder(torch.cat([own, state, self.embeddings[discrete]], -1)).chunk(2, -1)
        return mean, log_variance.clamp(-10.0, 4.0)

    def decode(self, state: Tensor, discrete: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the parameters `[B, num_parameters]` in [-1, 1] and the predicted, scaled change of the state."""
        hidden = self.decoder(torch.cat([z, state, self.embeddings[discrete]], -1))
        return self.parameter_head(hidden).tanh(), self.dynamics_head(hidden)

    def z_from_unit(self, unit: Tensor) -> Tensor:
        """Map the actor's [-1, 1] onto the central range of encoded data."""
        return self.z_low + (unit + 1.0) * 0.5 * (self.z_high - self.z_low)

    def z_to_unit(self, z: Tensor) -> Tensor:
        """Map z back to the actor's [-1, 1], clipped."""
        return (2.0 * (z - self.z_low) / (self.z_high - self.z_low) - 1.0).clamp(-1.0, 1.0)


class HyARPolicy(TensorDictModuleBase):
    """Actor, nearest key, decoder; explores with Gaussian noise in the latent space and with random presses."""

    def __init__(self, actor: nn.Module, codec: HybridCodec, specs: PAMDPSpecs, noise: float) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, LATENT]
        self.actor, self.codec, self.specs, self.noise = actor, codec, specs, noise
        self.register_buffer("epsilon", torch.ones(()))

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write key `[*B]`, parameters `[*B, num_parameters]` and the latent action `[*B, embedding_dim + latent_dim]`."""
        state = td.get(keys.OBSERVATION)
        exploring = not is_greedy()
        with torch.no_grad():
            latent = self.actor(state).tanh()
            if exploring:
                latent = (latent + self.noise * torch.randn_like(latent)).clamp(-1.0, 1.0)
            discrete, unit = self.decode(state, latent)
            if exploring and self.epsilon > 0.0:
                is_random = torch.rand_like(unit[..., :1]) < self.epsilon
                unit = torch.where(is_random, 2.0 * torch.rand_like(unit) - 1.0, unit)
                discrete = torch.where(
                    is_random.squeeze(-1), torch.randint_like(discrete, self.specs.num_discrete), discrete
                )
                latent = torch.where(is_random, torch.nan, latent)
        return td.update(
            {LATENT: latent, keys.ACTION: {"discrete": discrete, "parameters": self.specs.from_unit(unit)}}
        )

    def decode(self, state: Tensor, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Return the key `[B]` and the parameters `[B, num_parameters]` in [-1, 1] of a latent action."""
        e, z = latent.split([self.codec.table.shape[-1], self.codec.latent_dim], -1)
        discrete = self.codec.nearest_discrete(e)
        return discrete, self.codec.decode(state, discrete, self.codec.z_from_unit(z))[0]


class HyAR(ReplayLearner):
    """TD3 over the latent actions of a HybridCodec, trained off-policy from a replay buffer of its own."""

    has_value: ClassVar[bool] = True

    modes: ClassVar[tuple[str, ...]] = ("train",)  # it remembers its own latent actions beside the presses

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        embedding_dim: PositiveInt,
        latent_dim: PositiveInt,
        codec_hidden_dim: PositiveInt,
        hidden_dims: list[PositiveInt],
        warmup_frames: PositiveInt,
        codec_pretrain_updates: PositiveInt,
        codec_every: PositiveInt,
        codec_lr: PositiveFloat,
        kl_weight: NonNegativeFloat,
        dynamics_weight: NonNegativeFloat,
        latent_coverage: PositiveFraction,
        correction_threshold: NonNegativeFloat,
        buffer_size: PositiveInt,
        batch_size: PositiveInt,
        updates_per_frame: PositiveFloat,
        gamma: PositiveFraction,
        tau: PositiveFraction,
        actor_lr: PositiveFloat,
        critic_lr: PositiveFloat,
        policy_delay: PositiveInt,
        target_noise: NonNegativeFloat,
        target_noise_clip: NonNegativeFloat,
        exploration_noise: NonNegativeFloat,
        epsilon_final: Fraction,
        epsilon_frames: NonNegativeInt,
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
        self.codec_pretrain_updates, self.codec_every = codec_pretrain_updates, codec_every
        self.kl_weight, self.dynamics_weight, self.latent_coverage = kl_weight, dynamics_weight, latent_coverage
        self.correction_threshold, self.tau, self.policy_delay = correction_threshold, tau, policy_delay
        self.target_noise, self.target_noise_clip = target_noise, target_noise_clip
        self.epsilon_final, self.epsilon_frames = epsilon_final, epsilon_frames

        action_dim = embedding_dim + latent_dim
        self.codec = HybridCodec(specs, embedding_dim, latent_dim, codec_hidden_dim)
        self.actor = mlp(specs.observation_dim, hidden_dims, action_dim)
        self.critics = EnsembleMLP(2, specs.observation_dim + action_dim, hidden_dims, 1)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = HyARPolicy(self.actor, self.codec, specs, exploration_noise)
        self.to(device)
        self.optimizers = {
            "codec": torch.optim.Adam(self.codec.parameters(), lr=codec_lr, fused=True),
            "actor": torch.optim.Adam(self.actor.parameters(), lr=actor_lr, fused=True),
            "critics": torch.optim.Adam(self.critics.parameters(), lr=critic_lr, fused=True),
        }

    def value(self, observation: Tensor) -> Tensor:
        """Return Q of the actor's latent action, `[B]`."""
        return self.critics(torch.cat([observation, self.actor(observation).tanh()], -1)).squeeze(-1).amin(0)

    def explore(self, frames: int) -> None:
        """Let the share of random presses fall."""
        self.policy.epsilon.fill_(linear_schedule(frames, self.epsilon_frames, self.epsilon_final))

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return the rows to store with the latent actions that the actor gave."""
        return super().transitions(batch).set(LATENT, batch[LATENT])

    def start(self) -> None:
        """Train the codec alone."""
        seen = self.buffer[:]
        change = seen["next_state"] - seen["state"]
        # Entries that never change (the harbour's) keep a scale that makes them weigh nothing.
        self.codec.change_scale.copy_(change.std(0).clamp(min=1e-2))
        for _ in range(self.codec_pretrain_updates):
            self._update_codec(self.buffer.sample(self.batch_size))
        self._fit_latent_range()

    def _fit_latent_range(self) -> None:
        """Set the z range to the central `latent_coverage` of what the encoder gives for replayed presses."""
        sample = self.buffer.sample(4096)
        with torch.no_grad():
            z, _ = self.codec.encode(sample["state"], sample["discrete"], sample["unit"])
        tail = (1.0 - self.latent_coverage) / 2.0
        low, high = z.quantile(tail, 0), z.quantile(1.0 - tail, 0)
        self.codec.z_low.copy_(low)
        self.codec.z_high.copy_(torch.maximum(high, low + 1e-3))

    def _update_codec(self, batch: TensorDictBase) -> dict[str, Tensor]:
        mean, log_variance = self.codec.encode(batch["state"], batch["discrete"], batch["unit"])
        z = mean + (0.5 * log_variance).exp() * torch.randn_like(mean)
        unit, change = self.codec.decode(batch["state"], batch["discrete"], z)
        own = self.codec.mask[batch["discrete"]]
        reconstruction = ((unit - batch["unit"]).square() * own).sum(-1).mean()
        divergence = -0.5 * (1.0 + log_variance - mean.square() - log_variance.exp()).sum(-1).mean()
        target = (batch["next_state"] - batch["state"]) / self.codec.change_scale
        dynamics = F.mse_loss(change, target)
        loss = reconstruction + self.kl_weight * divergence + self.dynamics_weight * dynamics
        self.optimizer_step("codec", loss)
        return {"reconstruction": reconstruction, "kl": divergence, "dynamics": dynamics}

    def corrected_latent(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return latents `[B, embedding_dim + latent_dim]` that mean today what was pressed then, and which were redone.

        Representation-shift correction: e is replaced by the key's embedding where it no longer decodes to the key; z
        is encoded anew where the state change that it predicts is off by more than the threshold (scaled mean square).
        """
        state, discrete, latent = batch["state"], batch["discrete"], batch["latent"]
        with torch.no_grad():
            e, z = latent.split([self.codec.table.shape[-1], self.codec.latent_dim], -1)
            _, change = self.codec.decode(state, discrete, self.codec.z_from_unit(z))
            target = (batch["next_state"] - state) / self.codec.change_scale
            # NaN, the latent of a random press, compares False and so is redone.
            is_same_change = (change - target).square().mean(-1) <= self.correction_threshold
            is_same_discrete = (self.codec.nearest_discrete(e.nan_to_num()) == discrete) & ~e.isnan().any(-1)
            mean, _ = self.codec.encode(state, discrete, batch["unit"])
            e = torch.where(is_same_discrete.unsqueeze(-1), e, self.codec.embeddings[discrete])
            z = torch.where(is_same_change.unsqueeze(-1), z, self.codec.z_to_unit(mean))
        return torch.cat([e, z], -1), ~(is_same_discrete & is_same_change)

    def train_step(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update the critics, now and then also actor, targets and codec."""
        latent, redone = self.corrected_latent(sample)
        q = self.critics(torch.cat([sample["state"], latent], -1)).squeeze(-1)
        critic_loss = (q - self._target(sample)).square().mean(-1).sum()
        self.optimizer_step("critics", critic_loss)
        scalars = {"critic": critic_loss, "redone": redone.float().mean(), "epsilon": self.policy.epsilon}
        if self.updates % self.policy_delay == 0:
            scalars["actor"] = self._update_actor(sample["state"])
            polyak_update(self.target_actor, self.actor, self.tau)
            polyak_update(self.target_critics, self.critics, self.tau)
        if self.updates % self.codec_every == 0:
            scalars |= self._update_codec(sample)
            if self.updates % (100 * self.codec_every) == 0:
                self._fit_latent_range()
        return scalars

    def _update_actor(self, state: Tensor) -> Tensor:
        """Let the latent action ascend the first critic's value; return the loss."""
        self.critics.requires_grad_(False)
        loss = -self.critics(torch.cat([state, self.actor(state).tanh()], -1))[0].mean()
        self.optimizer_step("actor", loss)
        self.critics.requires_grad_(True)
        return loss

    def _target(self, batch: TensorDictBase) -> Tensor:
        """Return r + discount min Q'(s', smoothed action of the target actor), `[B]`."""
        with torch.no_grad():
            action = self.target_actor(batch["next_state"]).tanh()
            noise = self.target_noise * torch.randn_like(action)
            action = (action + noise.clamp(-self.target_noise_clip, self.target_noise_clip)).clamp(-1.0, 1.0)
            q = self.target_critics(torch.cat([batch["next_state"], action], -1)).squeeze(-1).amin(0)
            return batch["reward"] + batch["discount"] * q
