"""H-PPO: proximal policy optimisation with a discrete actor and a continuous actor for the parameters.

Both actors share an encoder, and one critic V(s) serves both. Each actor has its own probability ratio and its own
clipped surrogate; the ratio of the parameters covers the chosen action's own parameters alone.

Source: Fan, Su, Zhang and Yu, *Hybrid Actor-Critic Reinforcement Learning in Parameterized Action Space*, 2019, arXiv
1903.01344, section 4; PPO: Schulman, Wolski, Dhariwal, Radford and Klimov 2017, arXiv 1707.06347, equation 7; GAE:
Schulman, Moritz, Levine, Jordan and Abbeel 2016, arXiv 1506.02438, equation 16.

Differs from the source:
- the parameters are Gaussian in units where their bounds are [-1, 1]; the ratio is that of the raw sample, which is
  clipped only for execution, because the density of a squashed sample diverges at the bounds;
- the Gaussian's standard deviation has a lower limit, because the ratios explode where it shrinks faster than the mean
  moves; this limit, the learning rate and the entropy bonus are annealed over `anneal_steps` steps of the whole run;
- with `vector_products` actors and critic see products of the vectors that the problem declares, too.

The advantages are TorchRL's. Its ClipPPOLoss is not used because it multiplies the ratios of all heads and clips the
product.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.objectives.value.functional import generalized_advantage_estimate
from typing_extensions import Self

from hpamdp import keys
from hpamdp.policies.base import Learner, is_greedy
from hpamdp.policies.shared.default_dtype import float32_by_default
from hpamdp.policies.shared.exported_policy import exported_actor
from hpamdp.policies.shared.hybrid_actor import HybridActor, HybridDistribution, encoder
from hpamdp.policies.shared.networks import InitialParameters
from hpamdp.policies.shared.on_policy import OnPolicy, OnPolicyOptions
from hpamdp.settings import Fraction, LearningRate, Widths
from hpamdp.specs import PAMDPSpecs

# The policy also writes what the ratios need: the raw sample of the parameters.
RAW = "raw_parameters"


class HPPOOptions(OnPolicyOptions):
    """Settings of `HPPO`. Standard deviations are in units where the parameters' bounds are [-1, 1]."""

    hidden_dims: Annotated[Widths, Field(min_length=1)] = (128, 128)
    """Hidden layers of the encoder that both actors share."""
    critic_hidden_dims: Annotated[Widths, Field(min_length=1)] = (128, 128)
    """Hidden layers of the critic."""
    vector_products: bool = False
    """Show actors and critic the scalar and cross products of the vectors of the plane that the problem declares."""
    initial_parameters: InitialParameters = "none"
    """Initial means: `domain` takes the problem's own initial parameters, if it has any; `none` takes mid-range."""
    initial_scale: PositiveFloat = 0.5
    """Standard deviation of the parameters at the start."""
    min_scale: PositiveFloat = 0.06
    """Smallest standard deviation at the start."""
    min_scale_final: PositiveFloat = 0.02
    """Smallest standard deviation at the end; the limit is annealed from `min_scale` to this value."""
    max_scale: PositiveFloat = 1.0
    """Largest standard deviation."""
    epochs: Annotated[int, Field(ge=1, le=1000)] = 5
    """Passes over the collected steps in an update."""
    gamma: Fraction = 0.99
    """Discount of a step."""
    gae_lambda: Fraction = 0.95
    """Lambda of the generalised advantages: 0 bootstraps after one step, 1 at the end of the episode."""
    lr: LearningRate = 1e-3
    """Learning rate of actors and critic at the start."""
    lr_final: Fraction = 1e-4
    """Learning rate at the end; the rate is annealed from `lr` to this value."""
    critic_weight: PositiveFloat = 0.5
    """Weight of the critic's squared error beside the surrogates."""
    discrete_entropy: NonNegativeFloat = 0.01
    """Weight of the entropy bonus of the discrete action."""
    parameter_entropy: NonNegativeFloat = 0.0
    """Weight of the entropy bonus of the parameters."""
    entropy_final: Fraction = 0.1
    """Fraction of both entropy bonuses that is left at the end."""
    anneal_steps: PositiveInt = 200_000
    """Steps of the whole run over which learning rate, `min_scale` and entropy bonuses are annealed."""
    max_grad_norm: PositiveFloat = 1.0
    """Largest gradient norm, of actors and critic together."""
    greedy_discrete: Literal["most_probable", "sampled"] = "most_probable"
    """Discrete action of the greedy policy; its parameters are the means. `sampled` draws it, as in the published code.

    Always taking the same one of two equally good actions may lead nowhere, as turning on the spot does.
    """

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.min_scale < self.initial_scale < self.max_scale:
            raise ValueError(
                f"initial_scale={self.initial_scale}: must lie between min_scale={self.min_scale} and "
                f"max_scale={self.max_scale}"
            )
        if not self.min_scale_final < self.max_scale:
            raise ValueError(f"min_scale_final={self.min_scale_final}: must be less than max_scale={self.max_scale}")
        if self.lr_final > self.lr:
            raise ValueError(f"lr_final={self.lr_final}: must be at most lr={self.lr}")
        return self


class HPPOPolicy(TensorDictModuleBase):
    """Samples the action from the actor, or takes the most probable one when greedy.

    With `samples_when_greedy`, greedy discrete actions are sampled as well, and only their parameters are the means.
    """

    def __init__(self, actor: HybridActor, specs: PAMDPSpecs, samples_when_greedy: bool = False) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, RAW]
        self.actor = actor
        self.specs = specs
        self.samples_when_greedy = samples_when_greedy

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]`, the parameters and their raw sample, `[*B, num_parameters]` each."""
        observation = td.get(keys.OBSERVATION)
        allowed = self.specs.allowed(observation, td.get(keys.ACTION_MASK, None))
        distribution: HybridDistribution = self.actor(observation, allowed)
        if not is_greedy():
            discrete, raw = distribution.sample()
        elif self.samples_when_greedy:
            discrete, raw = distribution.sample_discrete()
        else:
            discrete, raw = distribution.mode()
        parameters = self.specs.from_unit(raw.clamp(-1.0, 1.0))
        return td.update({RAW: raw, keys.ACTION: {"discrete": discrete, "parameters": parameters}})


class HPPO(OnPolicy, Learner):
    """Clipped policy-gradient updates of both actors from the steps just collected."""

    Options = HPPOOptions

    frames: Tensor

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device | str = "cpu",
        options: HPPOOptions | None = None,
        **settings: Any,
    ) -> None:
        super().__init__(specs)
        self.options: HPPOOptions = HPPOOptions.of(options, settings)
        self.actor = HybridActor(
            specs,
            self.options.hidden_dims,
            (self.options.min_scale, self.options.max_scale),
            self.options.initial_scale,
            self.options.initial_parameters,
            vector_products=self.options.vector_products,
        )
        products = [] if self.actor.products is None else [self.actor.products]
        critic_dims = self.options.critic_hidden_dims
        self.critic = nn.Sequential(
            *products,
            encoder(self.actor.num_inputs, critic_dims),
            nn.Linear(critic_dims[-1], 1, dtype=torch.float32),
        )
        self.policy = HPPOPolicy(self.actor, specs, samples_when_greedy=self.options.greedy_discrete == "sampled")
        self.register_buffer("frames", torch.zeros((), dtype=torch.long))
        self.to(device)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=self.options.lr, eps=1e-5, fused=True)

    def compile_updates(self) -> None:
        """Compile the loss and its gradient, at the first update."""
        # Minibatches differ in size where other options take their share of the steps.
        self.descent.compile(self.frames.device, any_size=True)

    def lower_precision(self) -> None:
        """Have the matrix products of the loss and its gradient in bfloat16."""
        self.descent.lower_precision()

    def exported(self) -> dict[str, Any] | None:
        """Return the actor, unless it is to sample: see `hpamdp.policies.shared.exported_policy`."""
        return None if self.policy.samples_when_greedy else exported_actor(self.policy.actor, self.specs)

    def steps_to_update(self) -> dict[str, int]:
        """Return the size of a minibatch."""
        return {"minibatch_size": self.options.minibatch_size}

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Gather the rows in `mask` with their advantages; update once `minibatch_size` or more are waiting.

        Fewer rows, as of an option that is seldom chosen, wait for more; the policy that sampled them does not change
        until then.
        """
        progress = min(1.0, self.frames.item() / self.options.anneal_steps)
        self.frames += batch.numel()
        if not mask.any():
            return {}
        rows = self.gather(self._rows(batch, mask))
        if rows is None:
            return {}
        for group in self.optimizer.param_groups:
            group["lr"] = self.options.lr + progress * (self.options.lr_final - self.options.lr)
        # A tensor, since compiled code would be made anew for another number.
        entropy_weight = torch.tensor(
            1.0 + progress * (self.options.entropy_final - 1.0), device=rows.device, dtype=torch.float32
        )
        scalars = self.make_passes(rows, lambda minibatch: self.minimise(self._loss, minibatch, entropy_weight))
        first, last = self.options.min_scale, self.options.min_scale_final
        self.actor.set_min_scale(first * (last / first) ** progress)
        return scalars

    def advantages(self, batch: TensorDictBase, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return the generalised advantages and the targets of V, each `[*B, T]`; only the rows in `mask` are valid.

        Bootstrapping stops where the episode terminates, and the trace at truncations, too. Where options end inside
        their episodes, the trace goes on through the rows of the options that follow, each with the value of its own
        learner; where they last as long as their episodes, the rows of other learners are treated as zeros.
        """
        with torch.no_grad():
            if ("next", keys.OPTION_ENDED) in batch.keys(include_nested=True):
                value, next_value, reward = self._of_all_options(batch)
            else:
                value, next_value, reward = self._of_own_option(batch, mask)
            done, terminated = batch.get(("next", keys.DONE)), batch.get(("next", keys.TERMINATED))
            with float32_by_default():
                advantage, target = generalized_advantage_estimate(
                    self.options.gamma, self.options.gae_lambda, value, next_value, reward, done, terminated
                )
        return advantage.squeeze(-1), target.squeeze(-1)

    def value(self, observation: Tensor, action_mask: Tensor | None = None) -> Tensor:
        """Return V(s), `[N]`."""
        return self.critic(observation).squeeze(-1)

    def _of_own_option(self, batch: TensorDictBase, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the values of the states and of the next states and the rewards, `[*B, T, 1]`, 0 outside `mask`."""
        value = torch.zeros(*mask.shape, 1, device=mask.device, dtype=torch.float32)
        next_value = torch.zeros_like(value)
        reward = torch.zeros_like(value)
        value[mask] = self.critic(batch.get(keys.OBSERVATION)[mask])
        # The next state is that of the next row; but for the last row, and for the last state of a truncated episode.
        next_value[..., :-1, :] = value[..., 1:, :]
        done, terminated = (batch.get(("next", key)).squeeze(-1) for key in (keys.DONE, keys.TERMINATED))
        is_another = done.clone()
        is_another[..., -1] = True
        is_another &= mask & ~terminated
        next_value[is_another] = self.critic(batch.get(("next", keys.OBSERVATION))[is_another])
        reward[mask] = batch.get(("next", keys.REWARD))[mask]
        return value, next_value, reward

    def _of_all_options(self, batch: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
        """Return the values of the states and of the next states, each under its option, and the rewards."""
        value = self._under(batch.get(keys.OPTION), batch)
        next_value = self._under(batch.get(keys.NEXT_OPTION), batch.get("next"))
        return value, next_value, batch.get(("next", keys.REWARD))

    def _under(self, option: Tensor, states: TensorDictBase) -> Tensor:
        """Return the values `[*B, T, 1]` of states `[*B, T]` under options `[*B, T]`."""
        observation = states.get(keys.OBSERVATION).flatten(0, -2)
        masks = [states.get(keys.ACTION_MASK).flatten(0, -2)] if self.specs.has_action_mask else []
        return self.next_options.value(observation, option.flatten(), *masks).reshape(*option.shape, 1)

    def _rows(self, batch: TensorDictBase, mask: Tensor) -> TensorDict:
        """Return what an update needs of the rows in `mask`, `[N]`.

        Ratios are to the policy that the update begins with. Where the collector works ahead, an older one has acted,
        and ratios to that one would be clipped before anything was learned: Hilton, Cobbe and Schulman 2021, arXiv
        2110.00641, section 3.
        """
        advantage, target = self.advantages(batch, mask)
        rows = {
            keys.OBSERVATION: batch.get(keys.OBSERVATION)[mask],
            "discrete": batch.get(keys.DISCRETE)[mask],
            RAW: batch.get(RAW)[mask],
            "advantage": advantage[mask],
            "target": target[mask],
        }
        if self.specs.has_action_mask:
            rows[keys.ACTION_MASK] = batch.get(keys.ACTION_MASK)[mask]
        with torch.no_grad():
            log_probs = self._distribution(rows).log_prob(rows["discrete"], rows[RAW])
        rows["discrete_log_prob"], rows["parameter_log_prob"] = log_probs
        return TensorDict(rows, batch_size=[int(mask.sum())])

    def empty_rows(self) -> dict[str, Tensor]:
        """Return the columns of `_rows`."""
        number, observation = (
            torch.zeros(0, dtype=torch.float32),
            torch.zeros(0, self.specs.observation_dim, dtype=torch.float32),
        )
        names = ("advantage", "target", "discrete_log_prob", "parameter_log_prob")
        columns = {keys.OBSERVATION: observation, RAW: torch.zeros(0, self.specs.num_parameters, dtype=torch.float32)}
        columns |= {"discrete": number.long(), **dict.fromkeys(names, number)}
        if self.specs.has_action_mask:
            columns[keys.ACTION_MASK] = torch.zeros(0, self.specs.num_discrete, dtype=torch.bool)
        return columns

    def _distribution(self, rows: Mapping[str, Tensor]) -> HybridDistribution:
        allowed = self.specs.allowed(rows[keys.OBSERVATION], rows.get(keys.ACTION_MASK, None))
        distribution: HybridDistribution = self.actor(rows[keys.OBSERVATION], allowed)
        return distribution

    def _loss(self, rows: Mapping[str, Tensor], entropy_weight: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of actors and critic on a minibatch `[B]`, and scalars to log."""
        distribution = self._distribution(rows)
        discrete_log_prob, parameter_log_prob = distribution.log_prob(rows["discrete"], rows[RAW])
        discrete_log_ratio = discrete_log_prob - rows["discrete_log_prob"]
        parameter_log_ratio = parameter_log_prob - rows["parameter_log_prob"]
        discrete_gain = self.surrogate(discrete_log_ratio, rows["advantage"])
        parameter_gain = self.surrogate(parameter_log_ratio, rows["advantage"])
        gain = (discrete_gain + parameter_gain).mean()

        discrete_entropy, parameter_entropy = (entropy.mean() for entropy in distribution.entropy())
        bonus = self.options.discrete_entropy * discrete_entropy + self.options.parameter_entropy * parameter_entropy
        critic_loss = F.mse_loss(self.critic(rows[keys.OBSERVATION]).squeeze(-1), rows["target"])
        loss = self.options.critic_weight * critic_loss - gain - entropy_weight * bonus
        return loss, {
            "critic": critic_loss,
            "discrete_entropy": discrete_entropy,
            "scale": distribution.log_scale.detach().mean().exp(),
            "discrete_kl": kl_estimate(discrete_log_ratio.detach()),
            "parameter_kl": kl_estimate(parameter_log_ratio.detach()),
            "discrete_clipped": self._clipped_fraction(discrete_log_ratio.detach()),
            "parameter_clipped": self._clipped_fraction(parameter_log_ratio.detach()),
        }

    def _clipped_fraction(self, log_ratio: Tensor) -> Tensor:
        return (log_ratio.expm1().abs() > self.options.clip).float().mean()


def kl_estimate(log_ratio: Tensor) -> Tensor:
    """Estimate the divergence of the new policy from the old one as the mean of r - 1 - log(r), never negative.

    Source: Schulman 2020, *Approximating KL Divergence*, http://joschu.net/blog/kl-approx.html.
    """
    return (log_ratio.expm1() - log_ratio).mean()
