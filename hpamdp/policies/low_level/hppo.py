"""H-PPO: proximal policy optimisation with a discrete actor for the key and a continuous actor for its parameters.

Both actors stand on one encoder, one critic V(s) serves both, and each has a clipped surrogate with its own ratio. Only
the parameters of the key that was pressed have a likelihood.

Source: Fan, Su, Zhang and Yu, *Hybrid Actor-Critic Reinforcement Learning in Parameterized Action Space*, 2019, arXiv
1903.01344, section 4; PPO: Schulman, Wolski, Dhariwal, Radford and Klimov 2017, arXiv 1707.06347, equation 7; GAE:
Schulman, Moritz, Levine, Jordan and Abbeel 2016, arXiv 1506.02438, equation 16.

Differs from the source:
- the heads' surrogates are computed here and not by TorchRL's ClipPPOLoss, which multiplies the ratios of all heads and
  clips the product; the advantages are TorchRL's;
- a Gaussian in the units [-1, 1] of the bounds gives the parameters; the raw sample is kept for the ratio and clipped
  only where it is pressed, which spares the likelihood of a squashed one its poles at the bounds;
- the Gaussian's deviation has a floor, for ratios explode where it shrinks faster than the steps of its mean; floor,
  learning rate and entropy bonus fall over `anneal_frames` presses of the whole run.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.objectives.value.functional import generalized_advantage_estimate

from hpamdp import keys
from hpamdp.policies.base import Learner, is_greedy, option_ends
from hpamdp.policies.shared.fractions import Fraction
from hpamdp.policies.shared.hybrid_actor import HybridActor, encoder
from hpamdp.policies.shared.on_policy import OnPolicy
from hpamdp.specs import PAMDPSpecs

# What the ratio needs of a press: the parameters as they were drawn, in units of their bounds, and the log-likelihoods.
RAW, DISCRETE_LOG_PROB, PARAMETER_LOG_PROB = "raw_parameters", "discrete_log_prob", "parameter_log_prob"


class HPPOPolicy(TensorDictModuleBase):
    """Draws the press from the actor, or takes its likeliest one when greedy."""

    def __init__(self, actor: HybridActor, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, RAW, DISCRETE_LOG_PROB, PARAMETER_LOG_PROB]
        self.actor, self.specs = actor, specs

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write key `[*B]`, parameters `[*B, num_parameters]` and what the ratio needs of them."""
        with torch.no_grad():
            distribution = self.actor(td.get(keys.OBSERVATION))
            discrete, raw = distribution.mode() if is_greedy() else distribution.sample()
            discrete_log_prob, parameter_log_prob = distribution.log_prob(discrete, raw)
            duration = self.specs.from_unit(raw.clamp(-1.0, 1.0))
        written = {RAW: raw, DISCRETE_LOG_PROB: discrete_log_prob, PARAMETER_LOG_PROB: parameter_log_prob}
        return td.update({**written, keys.ACTION: {"discrete": discrete, "parameters": duration}})


class HPPO(OnPolicy, Learner):
    """Clipped policy-gradient updates of both actors from the presses just collected."""

    has_value: ClassVar[bool] = True

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        hidden_dims: Annotated[list[PositiveInt], Field(min_length=1)],
        critic_hidden_dims: Annotated[list[PositiveInt], Field(min_length=1)],
        initial_scale: PositiveFloat,
        min_scale: PositiveFloat,
        min_scale_final: PositiveFloat,
        max_scale: PositiveFloat,
        epochs: PositiveInt,
        minibatch_size: PositiveInt,
        clip: PositiveFloat,
        gamma: Fraction,
        gae_lambda: Fraction,
        lr: PositiveFloat,
        lr_final: NonNegativeFloat,
        critic_weight: PositiveFloat,
        discrete_entropy: NonNegativeFloat,
        parameter_entropy: NonNegativeFloat,
        entropy_final: Fraction,
        anneal_frames: PositiveInt,
        max_grad_norm: PositiveFloat,
    ) -> None:
        if not min_scale < initial_scale < max_scale:
            raise ValueError(f"initial_scale={initial_scale}: must lie between {min_scale=} and {max_scale=}")
        super().__init__(specs, epochs=epochs, minibatch_size=minibatch_size, clip=clip, max_grad_norm=max_grad_norm)
        self.gamma, self.gae_lambda, self.critic_weight = gamma, gae_lambda, critic_weight
        self.discrete_entropy, self.parameter_entropy, self.entropy_final = (
            discrete_entropy,
            parameter_entropy,
            entropy_final,
        )
        self.min_scale, self.min_scale_final = min_scale, min_scale_final
        self.lr, self.lr_final, self.anneal_frames = lr, lr_final, anneal_frames
        self.actor = HybridActor(specs, hidden_dims, (min_scale, max_scale), initial_scale)
        self.critic = nn.Sequential(
            encoder(specs.observation_dim, critic_hidden_dims), nn.Linear(critic_hidden_dims[-1], 1)
        )
        self.policy = HPPOPolicy(self.actor, specs)
        self.register_buffer("frames", torch.zeros((), dtype=torch.long))
        self.to(device)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr, eps=1e-5, fused=True)

    def value(self, observation: Tensor) -> Tensor:
        """Return V(s), `[B]`."""
        return self.critic(observation).squeeze(-1)

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Estimate the own rows' advantages; from a minibatch of rows on, make `epochs` passes over them.

        Fewer rows, as of an option that is seldom chosen, wait for more; the policy that drew them stays until then.
        """
        progress = min(1.0, self.frames.item() / self.anneal_frames)
        self.frames += batch.numel()
        if not mask.any():
            return {}
        rows = self.gather(self._rows(batch, mask))
        if rows is None:
            return {}
        for group in self.optimizer.param_groups:
            group["lr"] = self.lr + progress * (self.lr_final - self.lr)
        entropy_weight = 1.0 + progress * (self.entropy_final - 1.0)
        scalars = self.make_passes(rows, lambda minibatch: self._update(minibatch, entropy_weight))
        self.actor.set_min_scale(self.min_scale * (self.min_scale_final / self.min_scale) ** progress)
        return scalars

    def advantages(self, batch: TensorDictBase, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return the generalised advantages and the targets of V, each `[*B, T]`; they count in the rows of `mask`.

        Bootstrapping stops where an episode terminated, the trace where it is done or its option ends, for there
        another option's rows can begin; those rows are zeros here.
        """
        with torch.no_grad():
            value, next_value, reward = torch.zeros(3, *mask.shape, 1, device=mask.device)
            value[mask] = self.critic(batch.get(keys.OBSERVATION)[mask])
            next_value[mask] = self.critic(batch.get(("next", keys.OBSERVATION))[mask])
            reward[mask] = batch.get(("next", keys.REWARD))[mask]
            terminated = batch.get(("next", keys.TERMINATED))
            advantage, target = generalized_advantage_estimate(
                self.gamma, self.gae_lambda, value, next_value, reward, option_ends(batch), terminated
            )
        return advantage.squeeze(-1), target.squeeze(-1)

    def _rows(self, batch: TensorDictBase, mask: Tensor) -> TensorDict:
        advantage, target = (each[mask] for each in self.advantages(batch, mask))
        own = {name: batch.get(name)[mask] for name in (keys.OBSERVATION, RAW, DISCRETE_LOG_PROB, PARAMETER_LOG_PROB)}
        own |= {"discrete": batch.get(keys.DISCRETE)[mask], "advantage": advantage, "target": target}
        return TensorDict(own, batch_size=advantage.shape)

    def _update(self, rows: TensorDictBase, entropy_weight: float) -> dict[str, Tensor]:
        distribution = self.actor(rows[keys.OBSERVATION])
        discrete_log_prob, parameter_log_prob = distribution.log_prob(rows["discrete"], rows[RAW])
        discrete_log_ratio = discrete_log_prob - rows[DISCRETE_LOG_PROB]
        parameter_log_ratio = parameter_log_prob - rows[PARAMETER_LOG_PROB]
        gain = self.surrogate(discrete_log_ratio, rows["advantage"]) + self.surrogate(
            parameter_log_ratio, rows["advantage"]
        )
        discrete_entropy, parameter_entropy = (entropy.mean() for entropy in distribution.entropy())
        bonus = self.discrete_entropy * discrete_entropy + self.parameter_entropy * parameter_entropy
        critic_loss = F.mse_loss(self.critic(rows[keys.OBSERVATION]).squeeze(-1), rows["target"])
        self.optimizer_step(self.critic_weight * critic_loss - gain.mean() - entropy_weight * bonus)
        with torch.no_grad():
            # exp(x) - 1 - x, an estimate of the divergence that is never negative.
            ratios = (discrete_log_ratio, parameter_log_ratio)
            discrete_kl, parameter_kl = ((ratio.expm1() - ratio).mean() for ratio in ratios)
            clipped = [ratio.expm1().abs() > self.clip for ratio in ratios]
            return {
                "critic": critic_loss.detach(),
                "discrete_entropy": discrete_entropy.detach(),
                "scale": distribution.log_scale.mean().exp(),
                "discrete_kl": discrete_kl,
                "parameter_kl": parameter_kl,
                "discrete_clipped": clipped[0].float().mean(),
                "parameter_clipped": clipped[1].float().mean(),
            }
