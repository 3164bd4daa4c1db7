"""Hybrid SAC: soft actor-critic whose actor chooses among the keys and draws the parameters of each.

One network gives pi(k | s) and, for every key, a squashed Gaussian pi(x_k | s); twin critics give Q(s, k, x_k) with the
entropies of both, each weighed by a temperature of its own, as part of the return.

Source: Delalleau, Peter, Alonso and Logut, *Discrete and Continuous Action Representation for Practical RL in Video
Games*, 2019, arXiv 1912.11077 (parameterised actions, two temperatures). Tuned temperatures: Haarnoja et al. 2018,
arXiv 1812.05905, section 5. Exact expectation over discrete actions: Christodoulou 2019, arXiv 1910.07207.

Differs from the source:
- the critics are multi-pass (Bester, James and Konidaris 2019, arXiv 1905.04388): the value of a key sees its own
  parameters alone, so that those of the other keys get no false gradient and add no noise to the target;
- each temperature has a target: a share of the uniform keys' entropy, and nats for each parameter of the executed
  key, so that keys with more parameters, or none, need no target of their own;
- the actor and the temperatures may be updated less often than the critics, as in TD3 (arXiv 1802.09477).

TorchRL's SACLoss and DiscreteSACLoss do not fit: each takes a single action leaf and a single temperature, while the
expectation over keys here weighs the densities of parameters too. TanhNormal took 2.5 times as long as the density
taken here from the sample before its squashing, which also is exact at the bounds.
"""

from __future__ import annotations

import copy
import math
from typing import Annotated, ClassVar, NamedTuple

import torch
from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.policies.base import is_greedy
from hpamdp.policies.shared.fractions import PositiveFraction
from hpamdp.policies.shared.networks import HybridCritics, mlp, polyak_update, sample_index
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.specs import PAMDPSpecs


class HybridDistribution(NamedTuple):
    """Log-probabilities of the keys `[B, num_keys]`; before squashing, mean and deviation `[B, num_parameters]`."""

    discrete_log_probs: Tensor
    mean: Tensor
    scale: Tensor

    def sample_parameters(self) -> tuple[Tensor, Tensor]:
        """Draw all keys' parameters in [-1, 1], differentiably, and return them with their log-densities."""
        noise = torch.randn_like(self.mean)
        raw = self.mean + self.scale * noise
        gaussian = -0.5 * noise.square() - self.scale.log() - 0.5 * math.log(2.0 * math.pi)
        # log(1 - tanh(raw)^2) without its loss of digits
        return raw.tanh(), gaussian - 2.0 * (math.log(2.0) - raw - F.softplus(-2.0 * raw))


class HybridActor(nn.Module):
    """One network for the keys' probabilities and the parameters' Gaussians, deviations within `scale_range`."""

    def __init__(self, specs: PAMDPSpecs, hidden_dims: list[int], scale_range: tuple[float, float]) -> None:
        super().__init__()
        self.sizes = [specs.num_discrete, specs.num_parameters, specs.num_parameters]
        self.low, self.high = (math.log(scale) for scale in scale_range)
        self.net = mlp(specs.observation_dim, hidden_dims, sum(self.sizes))

    def forward(self, state: Tensor) -> HybridDistribution:
        """Return the distribution of the next press for states `[*B, observation_dim]`."""
        logits, mean, raw_scale = self.net(state).split(self.sizes, -1)
        log_scale = self.low + (self.high - self.low) * raw_scale.sigmoid()
        return HybridDistribution(logits.log_softmax(-1), mean, log_scale.exp())


class HSACPolicy(TensorDictModuleBase):
    """Draws key and parameters, uniformly during the warm-up; greedy: the likeliest key and the squashed means."""

    def __init__(self, actor: HybridActor, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.actor, self.specs = actor, specs
        self.register_buffer("is_random", torch.ones((), dtype=torch.bool))

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write key `[*B]` and parameters `[*B, num_parameters]`."""
        distribution = self.actor(td.get(keys.OBSERVATION))
        if is_greedy():
            discrete, unit = distribution.discrete_log_probs.argmax(-1), distribution.mean.tanh()
        elif self.is_random:
            unit = 2.0 * torch.rand_like(distribution.mean) - 1.0
            discrete = torch.randint(self.specs.num_discrete, unit.shape[:-1], device=unit.device)
        else:
            discrete, unit = sample_index(distribution.discrete_log_probs), distribution.sample_parameters()[0]
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": self.specs.from_unit(unit)}})


class HSAC(ReplayLearner):
    """Soft policy iteration over keys and their parameters, from a replay buffer of its own."""

    has_value: ClassVar[bool] = True

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        hidden_dims: list[PositiveInt],
        min_scale: PositiveFloat,
        max_scale: PositiveFloat,
        discrete_temperature: PositiveFloat,
        parameter_temperature: PositiveFloat,
        tune_discrete_temperature: bool,
        tune_parameter_temperature: bool,
        discrete_target_entropy: Annotated[float, Field(ge=0.0, lt=1.0)],
        parameter_target_entropy: Annotated[float, Field(lt=math.log(2.0))],
        temperature_lr: PositiveFloat,
        warmup_frames: NonNegativeInt,
        buffer_size: PositiveInt,
        batch_size: PositiveInt,
        updates_per_frame: PositiveFloat,
        policy_delay: PositiveInt,
        gamma: PositiveFraction,
        tau: PositiveFraction,
        actor_lr: PositiveFloat,
        critic_lr: PositiveFloat,
    ) -> None:
        if not min_scale < max_scale:
            raise ValueError(f"min_scale={min_scale}: must lie below max_scale={max_scale}")
        super().__init__(
            specs,
            device,
            gamma=gamma,
            warmup_frames=warmup_frames,
            buffer_size=buffer_size,
            batch_size=batch_size,
            updates_per_frame=updates_per_frame,
        )
        self.discrete_target_entropy = discrete_target_entropy * math.log(specs.num_discrete)
        self.parameter_target_entropy = parameter_target_entropy
        self.policy_delay, self.tau = policy_delay, tau

        self.actor = HybridActor(specs, hidden_dims, (min_scale, max_scale))
        self.critics = HybridCritics(specs, 2, hidden_dims, is_multipass=True)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.log_discrete_temperature = nn.Parameter(
            torch.tensor(math.log(discrete_temperature)), requires_grad=tune_discrete_temperature
        )
        self.log_parameter_temperature = nn.Parameter(
            torch.tensor(math.log(parameter_temperature)), requires_grad=tune_parameter_temperature
        )
        self.policy = HSACPolicy(self.actor, specs)
        self.to(device)
        temperatures = [self.log_discrete_temperature, self.log_parameter_temperature]
        self.optimizers = {
            "actor": torch.optim.Adam(self.actor.parameters(), lr=actor_lr, fused=True),
            "critics": torch.optim.Adam(self.critics.parameters(), lr=critic_lr, fused=True),
            "temperatures": torch.optim.Adam(temperatures, lr=temperature_lr, fused=True),
        }

    def value(self, observation: Tensor) -> Tensor:
        """Return the soft value, `[B]`."""
        return self.soft_value(self.critics, observation)[0]

    def explore(self, frames: int) -> None:
        """Leave the presses to the actor."""
        self.policy.is_random.fill_(False)

    def temperatures(self) -> tuple[Tensor, Tensor]:
        """Return the weights of the keys' and of the parameters' entropy, which carry no gradient."""
        return self.log_discrete_temperature.detach().exp(), self.log_parameter_temperature.detach().exp()

    def soft_value(self, critics: HybridCritics, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the value of states `[B, observation_dim]` and both entropies less their targets, each `[B]`.

        V = sum_k pi(k) [min Q(k, x_k) - a log pi(k) - b log pi(x_k)] with drawn x_k: exact over keys, so that only the
        parameters of the key that is executed weigh in the entropy.
        """
        discrete_weight, parameter_weight = self.temperatures()
        distribution = self.actor(state)
        unit, log_density = distribution.sample_parameters()
        discrete_log_probs, own_log_density = distribution.discrete_log_probs, log_density @ critics.mask.T
        q = critics(state, unit).amin(0) - discrete_weight * discrete_log_probs - parameter_weight * own_log_density
        pi = discrete_log_probs.exp()
        discrete_excess = -(pi * discrete_log_probs).sum(-1) - self.discrete_target_entropy
        own_target = self.parameter_target_entropy * critics.mask.sum(-1)
        return (pi * q).sum(-1), discrete_excess, -(pi * (own_log_density + own_target)).sum(-1)

    def train_step(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update the critics, now and then also actor and temperatures."""
        q = self.critics.of_discrete(sample["state"], sample["discrete"], sample["unit"])
        critic_loss = (q - self._target(sample)).square().mean(-1).sum()
        self.optimizer_step("critics", critic_loss)
        discrete_temperature, parameter_temperature = self.temperatures()
        scalars = {"critic": critic_loss, "q": q.mean()}
        scalars |= {"discrete_temperature": discrete_temperature, "parameter_temperature": parameter_temperature}
        if self.updates % self.policy_delay == 0:
            scalars |= self._update_actor(sample["state"])
            self._update_temperatures(scalars["discrete_excess"], scalars["parameter_excess"])
        polyak_update(self.target_critics, self.critics, self.tau)
        return scalars

    def _target(self, batch: TensorDictBase) -> Tensor:
        """Return r + discount V'(s'), `[B]`, where the discount is 0 after a termination."""
        with torch.no_grad():
            value, _, _ = self.soft_value(self.target_critics, batch["next_state"])
            return batch["reward"] + batch["discount"] * value

    def _update_actor(self, state: Tensor) -> dict[str, Tensor]:
        """Let the actor ascend the soft value; return the loss and the mean entropies less their targets."""
        self.critics.requires_grad_(False)
        value, discrete_excess, parameter_excess = self.soft_value(self.critics, state)
        loss = -value.mean()
        self.optimizer_step("actor", loss)
        self.critics.requires_grad_(True)
        return {"actor": loss, "discrete_excess": discrete_excess.mean(), "parameter_excess": parameter_excess.mean()}

    def _update_temperatures(self, discrete_excess: Tensor, parameter_excess: Tensor) -> None:
        """Lower a temperature where its entropy exceeds the target, raise it where it falls short."""
        loss = self.log_discrete_temperature * discrete_excess.detach()
        loss = loss + self.log_parameter_temperature * parameter_excess.detach()
        if loss.requires_grad:
            self.optimizer_step("temperatures", loss)
