"""H-PPO: proximal policy optimisation with a discrete actor and a continuous actor for the parameters.

Both actors share their hidden layers, and one critic V(s) serves both. Each actor has its own probability ratio and its
own clipped surrogate. The ratio of the parameters covers only the chosen action's own parameters.

Source: Fan, Su, Zhang and Yu, *Hybrid Actor-Critic Reinforcement Learning in Parameterized Action Space*, 2019, arXiv
1903.01344, section 4; PPO: Schulman, Wolski, Dhariwal, Radford and Klimov 2017, arXiv 1707.06347, equation 7; GAE:
Schulman, Moritz, Levine, Jordan and Abbeel 2016, arXiv 1506.02438, equation 16.

Differs from the source:
- The parameters are Gaussian in units where their bounds are [-1, 1]. The ratio is that of the raw sample, which is
  clipped only for execution: the density of a squashed sample diverges at the bounds.
- The Gaussian's standard deviation has a lower limit. Without it the ratios explode when the standard deviation shrinks
  faster than the mean moves. This limit, the learning rate and the entropy bonus are annealed over `anneal_steps`, and
  so is an upper limit, if `max_scale_final` is set.
- With `vector_products` actors and critic also see products of the vectors that the problem declares.
- If an exploration takes another action than the policy's (`is_overruled`), the step has no part in the surrogates. It
  counts in the values, and in the advantages of the steps before it. This is still an unbiased policy gradient, because
  the policy does not affect when and how the exploration acts.
- With `memory` actors and critic share a memory of the history. A recurrent one is trained on whole sequences, each
  from the state that was stored at its first step.

The advantages are TorchRL's. Its ClipPPOLoss does not fit: it multiplies the ratios of all heads and clips the
product.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.devices import Device, checked_device
from hpamdp.policies.base import Learner, States, step_discounts
from hpamdp.policies.low_level.hppo_options import CARDS, HPPOOptions
from hpamdp.policies.shared.autoregressive_actor import AutoregressiveActor
from hpamdp.policies.shared.credit import CreditCritic
from hpamdp.policies.shared.exploration import schedule_progress
from hpamdp.policies.shared.exported_policy import exported_actor
from hpamdp.policies.shared.hybrid_actor import RAW, HybridActor, HybridPolicy, hidden_layers
from hpamdp.policies.shared.hybrid_distribution import HybridDistribution
from hpamdp.policies.shared.networks import OutputLinear
from hpamdp.policies.shared.on_policy import WAITING, OnPolicy, generalised_advantages, mean_scalars, normalised
from hpamdp.policies.shared.perception import Perception
from hpamdp.policies.shared.sequences import sequence_starts
from hpamdp.specs import PAMDPSpecs

# 1 for a step that the policy itself has taken, else 0.
OWN = "is_own"
# For each component, the part of a step's advantage that the other components contributed.
BASELINE = "credit_baseline"


class HPPO(OnPolicy, Learner):
    """Clipped policy-gradient updates of both actors from the steps just collected."""

    Options = HPPOOptions
    card = CARDS["HPPO"]
    # A new run does not take over rows that wait for an update: they may come from another problem.
    progress = Learner.progress | {"log_min_scale", "log_max_scale", WAITING}

    def __init__(self, specs: PAMDPSpecs, *, device: Device = "cpu", options: Any = None, **settings: Any) -> None:
        super().__init__(specs)
        options = HPPOOptions.of(options, settings)
        self.options: HPPOOptions = options
        self.perception = Perception(specs, options)
        self.memory_key = self.perception.memory_key
        self.memory_lasts_an_episode = self.perception.lasts_an_episode
        actor = AutoregressiveActor if options.autoregressive else HybridActor
        self.actor = actor(
            self.perception.specs,
            options.hidden_dims,
            (options.min_scale, options.max_scale),
            options.initial_scale,
            options.initial_parameters,
            vector_products=options.vector_products,
            greedy_parameters=options.greedy_parameters,
        )
        products = [] if self.actor.products is None else [self.actor.products]
        self.critic = nn.Sequential(
            *products,
            hidden_layers(self.actor.num_inputs, options.critic_hidden_dims),
            OutputLinear(options.critic_hidden_dims[-1], 1, dtype=torch.float32),
        )
        has_credit = options.credit != "joint" and not specs.components.is_single
        self.credit_critic = (
            CreditCritic(self.perception.specs, options.critic_hidden_dims, options.credit) if has_credit else None
        )
        samples = options.greedy_discrete == "sampled"
        self.policy = HybridPolicy(
            self.actor, specs, writes_raw=True, samples_when_greedy=samples, perception=self.perception
        )
        self.frames: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))
        self.to(checked_device(self, device))
        self.optimizer = torch.optim.Adam(self._groups(), lr=options.lr, eps=1e-5, fused=True)
        self.first_rates = [group["lr"] for group in self.optimizer.param_groups]

    def _groups(self) -> list[dict[str, Any]]:
        """Return the parameters of the optimizer, those of the critic apart if it has a learning rate of its own."""
        rate = self.options.critic_lr
        if rate is None:
            return [{"params": list(self.parameters())}]
        others = [each for name, each in self.named_parameters() if not name.startswith("critic.")]
        return [{"params": others}, {"params": list(self.critic.parameters()), "lr": rate}]

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Gather the rows in `mask` with their advantages; update once `minibatch_size` or more are waiting.

        Fewer rows, as of an option that is seldom chosen, wait for more. The policy that sampled them does not change
        until then.
        """
        options = self.options
        progress = min(1.0, self.frames.item() / options.anneal_steps)
        self.frames += batch.numel()
        rows = self.gather(self.rows(batch, mask)) if mask.any() else None
        if rows is None:
            return {}
        if self.credit_critic is not None:
            rows["advantage"] = rows["advantage"].unsqueeze(-1) - rows[BASELINE]
        rows["advantage"] = normalised(rows["advantage"], rows.get(OWN, None), least=options.least_deviation)
        rate = options.lr + schedule_progress(progress, options.lr_schedule) * (options.lr_final - options.lr)
        for group, first_rate in zip(self.optimizer.param_groups, self.first_rates, strict=True):
            group["lr"] = rate * (first_rate / options.lr)
        # A tensor, because compiled code would be compiled again for each new number.
        left = 1.0 + progress * (options.entropy_final - 1.0)
        entropy_weight = torch.tensor(left, device=rows.device, dtype=torch.float32)
        steps = [self.gradient_step(self.loss, minibatch, entropy_weight) for minibatch in self.minibatches(rows)]
        for minibatch in self.minibatches(rows, options.critic_epochs):
            self.gradient_step(self.critic_loss, minibatch)
        # Kept for reproducibility: `min_scale` uses the progress before this batch, `max_scale` the progress after it.
        self.actor.set_min_scale(options.min_scale * (options.min_scale_final / options.min_scale) ** progress)
        if options.max_scale_final is not None:
            fall = options.max_scale_final / options.max_scale
            next_progress = min(1.0, self.frames.item() / options.anneal_steps)
            self.actor.set_max_scale(options.max_scale * fall**next_progress)
        return mean_scalars(steps)

    def loss(self, rows: Mapping[str, Tensor], entropy_weight: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of actors and critic on a minibatch `[B]`, and scalars to log."""
        features = self.features(rows)
        distribution = self._distribution(features, rows)
        log_ratios = self.log_ratios(distribution, rows)
        gain = self.gain(log_ratios, rows)
        discrete_entropy, parameter_entropy = (entropy.mean() for entropy in distribution.entropy())
        bonus = self.options.discrete_entropy * discrete_entropy + self.options.parameter_entropy * parameter_entropy
        critic_loss = F.mse_loss(self.critic(features).squeeze(-1), rows["target"])
        if self.credit_critic is not None:
            action = rows["discrete"], rows[RAW]
            critic_loss = critic_loss + self.credit_critic.loss(features, distribution, *action, rows["raw_advantage"])
        loss = self.options.critic_weight * critic_loss - gain - entropy_weight * bonus
        scale = distribution.log_scale.detach().mean().exp()
        discrete_log_ratio, parameter_log_ratio = (log_ratio.detach() for log_ratio in log_ratios)
        return loss, {
            "critic": critic_loss,
            "discrete_entropy": discrete_entropy,
            "scale": scale if self.specs.num_parameters else torch.zeros_like(scale),
            "discrete_kl": kl_estimate(discrete_log_ratio),
            "parameter_kl": kl_estimate(parameter_log_ratio),
            "discrete_clipped": clipped_fraction(discrete_log_ratio, self.options.clip),
            "parameter_clipped": clipped_fraction(parameter_log_ratio, self.options.clip),
        }

    def log_ratios(self, distribution: HybridDistribution, rows: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the log-ratios of new and old probabilities, of discrete actions and of parameters, each `[B, *]`.

        They are 0 for actions of an exploration. These are set before the exponential, which may overflow for actions
        that the policy hardly takes.
        """
        discrete, parameters = distribution.log_prob(rows["discrete"], rows[RAW])
        log_ratios = discrete - rows["discrete_log_prob"], parameters - rows["parameter_log_prob"]
        if OWN not in rows:
            return log_ratios
        is_own = rows[OWN].reshape(-1, *[1] * (discrete.ndim - 1)) > 0.0
        return torch.where(is_own, log_ratios[0], 0.0), torch.where(is_own, log_ratios[1], 0.0)

    def gain(self, log_ratios: tuple[Tensor, Tensor], rows: Mapping[str, Tensor]) -> Tensor:
        """Return the mean surrogate of both actors over the actions that the policy has chosen, a scalar."""
        advantage = rows["advantage"]
        if advantage.ndim < log_ratios[0].ndim:  # the same for each component
            advantage = advantage.unsqueeze(-1)
        discrete_gain, parameter_gain = (self.surrogate(each, advantage) for each in log_ratios)
        gain = self.specs.components.total(discrete_gain + parameter_gain)
        if OWN not in rows:
            return gain.mean()
        return (gain * rows[OWN]).sum() / rows[OWN].sum().clamp(min=1.0)

    def critic_loss(self, rows: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the squared error of V on a minibatch `[B]`, for a step of the critic alone, and nothing to log."""
        with torch.no_grad():
            features = self.features(rows)
        return self.options.critic_weight * F.mse_loss(self.critic(features).squeeze(-1), rows["target"]), {}

    @torch.no_grad()
    def rows(self, batch: TensorDictBase, mask: Tensor) -> TensorDict:
        """Return what an update needs of the rows in `mask`, `[N]`.

        The log-probabilities are those of the policy that the update begins with. If the collector works ahead, an
        older policy has acted, and ratios to that one would be clipped before anything was learned: Hilton, Cobbe and
        Schulman 2021, arXiv 2110.00641, section 3. They have the precision of the update, for the same reason.
        """
        advantage, target = self.advantages(batch, mask)
        rows = {
            keys.OBSERVATION: batch.get(keys.OBSERVATION)[mask],
            "discrete": batch.get(keys.DISCRETE)[mask],
            RAW: batch.get(RAW)[mask],
            "advantage": advantage[mask],
            "target": target[mask],
        }
        if self.is_overruled:
            is_held = batch.get(keys.IS_HELD)[mask]
            taken = self.specs.to_unit(batch.get(keys.PARAMETERS), batch)[mask]
            rows[RAW] = torch.where(is_held.unsqueeze(-1), taken, rows[RAW])
            rows[OWN] = (~is_held).to(torch.float32)
        if self.specs.has_action_mask:
            rows[keys.ACTION_MASK] = batch.get(keys.ACTION_MASK)[mask]
        if self.specs.has_pair_mask:
            rows[keys.PAIR_MASK] = batch.get(keys.PAIR_MASK)[mask]
        if self.memory_key is not None:
            rows["memory"] = batch.get(self.memory_key)[mask]
        if self.perception.is_recurrent:
            rows["begins"] = self.perception.begins(batch)[mask]
            rows["starts"] = sequence_starts(self.perception.begins(batch), mask, self.options.sequence_length)
        with self.descent.same_precision(self.frames.device):
            features = self.features(rows)
            distribution = self._distribution(features, rows)
            log_probs = distribution.log_prob(rows["discrete"], rows[RAW])
            rows["discrete_log_prob"], rows["parameter_log_prob"] = log_probs
            if self.credit_critic is not None:
                rows[BASELINE] = self.credit_critic.baselines(features, distribution, rows["discrete"], rows[RAW])
                rows["raw_advantage"] = rows["advantage"]
        return TensorDict(rows, batch_size=[int(mask.sum())])

    @torch.no_grad()
    def advantages(self, batch: TensorDictBase, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return the generalised advantages and the targets of V, each `[*B, T]`; only the rows in `mask` are valid.

        Bootstrapping stops where the episode terminates; the trace stops at truncations, too. If options end inside
        their episodes, the trace goes on through the rows of the options that follow. Each row has the value of its own
        learner. If options last as long as their episodes, the rows of other learners are treated as zeros.
        """
        after = batch.get("next")
        if keys.OPTION_ENDED in after.keys():
            value = self._value_under(batch.get(keys.OPTION), batch, self._memory(batch), has_seen=True)
            next_value = self._value_under(batch.get(keys.NEXT_OPTION), after, self._held_on(batch))
            reward = after.get(keys.REWARD)
        else:
            value, next_value = self._own_values(batch, mask)
            reward = torch.zeros_like(value)
            reward[mask] = after.get(keys.REWARD)[mask]
        ends = after.get(keys.DONE), after.get(keys.TERMINATED)
        advantage, target = generalised_advantages(
            value,
            next_value,
            self.options.reward_scale * reward,
            *ends,
            gamma=step_discounts(batch, self.options.gamma),
            gae_lambda=self.options.gae_lambda,
        )
        return advantage.squeeze(-1), target.squeeze(-1)

    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return V(s), `[N]`."""
        return self.critic(self.perception.of_states(states)).squeeze(-1)

    def features(self, rows: Mapping[str, Tensor]) -> Tensor:
        """Return what actors and critic see of rows `[N]`, `[N, perception.specs.observation_dim]`."""
        if self.perception.is_recurrent:
            columns = (rows[name] for name in (keys.OBSERVATION, "memory", "begins", "starts"))
            return self.perception.of_sequences(*columns)
        return self.perception(rows[keys.OBSERVATION], rows.get("memory", None), has_seen=True)

    def _memory(self, batch: TensorDictBase) -> Tensor | None:
        return None if self.memory_key is None else batch.get(self.memory_key)

    def _own_values(self, batch: TensorDictBase, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return the values of the states and of the next states, `[*B, T, 1]`, 0 outside `mask`."""
        memory = self._memory(batch)

        def value_of(states: TensorDictBase, rows: Tensor, *, has_seen: bool) -> Tensor:
            asked = States(states.get(keys.OBSERVATION), None, memory, self.memory_key, has_seen)
            return self.value(asked.at(rows)).unsqueeze(-1)

        value = torch.zeros(*mask.shape, 1, device=mask.device, dtype=torch.float32)
        value[mask] = value_of(batch, mask, has_seen=True)
        # The next state is that of the next row, except after the last row and where an episode is truncated.
        next_value = torch.zeros_like(value)
        next_value[..., :-1, :] = value[..., 1:, :]
        done, terminated = (batch.get(("next", key)).squeeze(-1) for key in (keys.DONE, keys.TERMINATED))
        is_another = done.clone()
        is_another[..., -1] = True
        is_another &= mask & ~terminated
        next_value[is_another] = value_of(batch.get("next"), is_another, has_seen=False)
        return value, next_value

    def _value_under(
        self, option: Tensor, states: TensorDictBase, memory: Tensor | None, *, has_seen: bool = False
    ) -> Tensor:
        """Return the values `[*B, T, 1]` of states `[*B, T]` under options `[*B, T]`; see `NextOptions.value`."""
        observation = states.get(keys.OBSERVATION).flatten(0, -2)
        mask = states.get(keys.ACTION_MASK).flatten(0, -2) if self.specs.has_action_mask else None
        memory = None if memory is None else memory.flatten(0, -2)
        asked = States(observation, mask, memory, self.memory_key, has_seen)
        return self.next_options.value(asked, option.flatten()).reshape(*option.shape, 1)

    def _held_on(self, batch: TensorDictBase) -> Tensor | None:
        """Return the memories `[*B, T, size]` for the values of the next states; zeros where an option has ended."""
        if self.memory_key is None:
            return None
        memory: Tensor = batch.get(self.memory_key)
        if self.perception.lasts_an_episode:
            return memory
        is_ended = batch.get(("next", keys.OPTION_ENDED)).squeeze(-1)
        if self.next_options.decides_ends:
            # The next batch will show whether the last step's option ends. It goes on if the selector would hold it.
            is_ended = is_ended.clone()
            is_ended[..., -1] &= (batch.get(keys.NEXT_OPTION) != batch.get(keys.OPTION))[..., -1]
        return torch.where(is_ended.unsqueeze(-1), 0.0, memory)

    def _distribution(self, features: Tensor, rows: Mapping[str, Tensor]) -> HybridDistribution:
        allowed = self.specs.allowed(rows[keys.OBSERVATION], rows.get(keys.ACTION_MASK, None))
        pair_mask = rows.get(keys.PAIR_MASK, None)
        return self.actor.given(features, rows["discrete"], rows[RAW], allowed, pair_mask)

    def compile_updates(self) -> None:
        """Compile the loss and its gradient, at the first update.

        Raises:
            ValueError: it cannot be traced, or this machine cannot compile.
        """
        self.perception.check_traceable()
        # Minibatches differ in size if other options take some of the steps.
        self.descent.compile(self.frames.device, any_size=True, while_compiling=lambda: self.while_compiling())

    def lower_precision(self) -> None:
        """Have the matrix products of the loss and its gradient in bfloat16."""
        self.descent.lower_precision()

    def exported(self) -> dict[str, Any] | None:
        """Return the actor, unless it samples, sees features or acts by clipped means.

        See `hpamdp.policies.shared.exported_policy`.
        """
        is_mean = self.options.greedy_parameters == "mean"
        if self.policy.samples_when_greedy or not is_mean or not self.perception.is_plain:
            return None
        return exported_actor(self.actor, self.specs)

    def num_updates(self, steps: int) -> int:
        """Return the passes over this many steps, in minibatches."""
        return self.options.epochs * steps // self.options.minibatch_size


def kl_estimate(log_ratio: Tensor) -> Tensor:
    """Estimate the divergence of the new policy from the old one as the mean of r - 1 - log(r), never negative.

    Source: Schulman 2020, *Approximating KL Divergence*, http://joschu.net/blog/kl-approx.html.
    """
    return (log_ratio.expm1() - log_ratio).mean()


def clipped_fraction(log_ratio: Tensor, clip: float) -> Tensor:
    """Return the fraction of the ratios that are further from 1 than `clip`."""
    return (log_ratio.expm1().abs() > clip).float().mean()
