"""Hybrid SAC: soft actor-critic that chooses a discrete action and samples the parameters of each.

One network gives pi(k | s) and, for every discrete action k, a squashed Gaussian pi(x_k | s). Twin critics give
Q(s, k, x_k), in which the entropies of both are part of the return, each weighted by its own temperature.

Source: Delalleau, Peter, Alonso and Logut, *Discrete and Continuous Action Representation for Practical RL in Video
Games*, 2019, arXiv 1912.11077 (parameterised actions, two temperatures). Tuned temperatures: Haarnoja et al. 2018,
arXiv 1812.05905, section 5. Exact expectation over discrete actions: Christodoulou 2019, arXiv 1910.07207.

Differs from the source:
- The critics are multi-pass (Bester, James and Konidaris 2019, arXiv 1905.04388): the value of a discrete action sees
  its own parameters alone. So the others neither receive false gradients nor add noise to the target.
- Each temperature has a target entropy: a fraction of the uniform distribution's for the discrete action, and nats for
  each parameter of the executed action. So actions with more parameters, or none, need no target of their own.
- The actor and the temperatures may be updated less often than the critics, as in TD3 (arXiv 1802.09477). The code of
  Haarnoja et al. (github.com/rail-berkeley/softlearning) updates all three for each step. Here critics have an update
  for every four steps.
- The loss of a temperature is linear in its logarithm, in that code in the temperature itself. The entropy in it is
  that of the actor's update. In that code the updated actor is sampled again.
- By default temperatures start at 0.01 and 0.005, learning rates are 1e-3 and the target rate is 0.01. In that code
  these are 1, 3e-4 and 0.005.
- The standard deviation of the parameters lies between 0.005 and 1. In that code its only limit is 1e-5, from below.
- If an action has several components, the expectation over all discrete actions would be a sum over all combinations.
  The soft value is then the mean of `component_samples` sampled actions, and the critics value the action as a whole.
  The discrete heads get a policy gradient, whose baseline is the mean of the other samples (Kool, van Hoof and Welling
  2019, *Buy 4 REINFORCE Samples, Get a Baseline for Free!*). The parameters get a gradient through the critics.
- With `autoregressive`, each component's choice is a step of its own (Metz et al. 2017, *Discrete Sequential Prediction
  of Continuous Actions for Deep RL*, arXiv 1705.05035). Its state includes the earlier components' choices. These come
  from the replay buffer, so heads also learn after choices that the policy no longer makes. Without that, the first
  component would settle too early: the later ones would not yet know what best follows its other choices. The
  expectation over a component's own choices is exact.

TorchRL's SACLoss does not fit: it sums the log-probabilities of all action leaves under one temperature. Its
DiscreteSACLoss has no parameters, and the expectation over discrete actions here also weighs their log-densities.
Sampling parameters with their densities from TorchRL's TanhNormal takes 2 to 4 times as long as the
`HybridDistribution` used here. Its densities are wrong near the bounds, where it inverts the tanh.
"""

from __future__ import annotations

import copy
import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from hpamdp.acting import is_greedy
from hpamdp.policies.base import States
from hpamdp.policies.low_level.hsac_options import CARDS, HSACOptions
from hpamdp.policies.masks import masked_logits, random_action, zero_fixed
from hpamdp.policies.shared.autoregressive_actor import AutoregressiveActor
from hpamdp.policies.shared.gradients import adam
from hpamdp.policies.shared.hybrid_actor import DistributionActor, HybridActor, HybridPolicy
from hpamdp.policies.shared.hybrid_distribution import (
    HybridDistribution,
    gaussian_log_density,
    log_slope_of_tanh,
)
from hpamdp.policies.shared.networks import (
    HybridCritics,
    InitialLayer,
    JointCritics,
    as_preactivations,
    mlp,
    polyak_update,
    unsquashed,
)
from hpamdp.policies.shared.perception import Perception
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.specs import PAMDPSpecs

# Squashed parameters of executed actions are clamped to this number, whose inverse tanh is finite.
_LARGEST_EXECUTED = 1.0 - 1e-6


class HSACActor(DistributionActor):
    """One network for the logits of the discrete actions and the Gaussians of their parameters, before squashing."""

    def __init__(self, specs: PAMDPSpecs, options: HSACOptions) -> None:
        super().__init__()
        self.components = specs.components
        self.sizes = [specs.num_discrete, specs.num_parameters, specs.num_parameters]
        self.log_min_scale, self.log_max_scale = (math.log(scale) for scale in options.scale_range)
        self.net = mlp(specs.observation_dim, options.hidden_dims, sum(self.sizes))
        self.initial = InitialLayer(specs, options.initial_parameters, is_squashed=True)
        means = slice(specs.num_discrete, specs.num_discrete + specs.num_parameters)
        self.initial.shrink(self.net[-1], means)
        self.owner = nn.Buffer(specs.parameter_owner, persistent=False)

    def forward(self, state: Tensor, mask: Tensor | None = None) -> HybridDistribution:
        """Return the distribution of the action for states `[*B, observation_dim]`.

        Args:
            state: the observations.
            mask: the discrete actions that may be taken, bool `[*B, num_discrete]`; if None, all.
        """
        logits, mean, raw_scale = as_preactivations(self.net(state)).split(self.sizes, -1)
        mean = mean + self.initial(state)
        log_scale = self.log_min_scale + (self.log_max_scale - self.log_min_scale) * raw_scale.sigmoid()
        log_probs = masked_logits(logits, mask).log_softmax(-1)
        return HybridDistribution(log_probs, mean, log_scale, self.owner, self.components)


class HSACPolicy(HybridPolicy):
    """Sample from the actor, or uniformly during the warm-up.

    If greedy, take the most probable discrete action with its squashed means.
    """

    def __init__(self, actor: DistributionActor, perception: Perception, specs: PAMDPSpecs) -> None:
        super().__init__(actor, specs, bound=torch.tanh, perception=perception)
        self.is_random = nn.Buffer(torch.ones((), dtype=torch.bool))

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]` and the parameters `[*B, num_parameters]`."""
        if is_greedy() or not self.is_random:
            return super().forward(td)
        self.perception.see(td)
        return random_action(self.specs, td)


class HSAC(ReplayLearner):
    """Soft policy iteration over discrete actions and their parameters, from a replay buffer of its own."""

    Options = HSACOptions
    card = CARDS["HSAC"]
    stores_own_parameters = True

    options: HSACOptions
    policy: HSACPolicy

    def make_networks(self, specs: PAMDPSpecs) -> None:
        """Make the networks and the policy."""
        options = self.options
        self.max_discrete_entropy = sum(math.log(size) for size in specs.components.sizes)
        self.parameter_dims = nn.Buffer(torch.tensor(specs.parameter_dims).float(), persistent=False)
        self.set_perception(options)
        self.actor = make_actor(self.perception.specs, options)
        self.critics: HybridCritics | JointCritics = (
            HybridCritics(self.perception.specs, 2, options.hidden_dims, is_multipass=True)
            if isinstance(self.actor, HSACActor)
            else JointCritics(self.perception.specs, 2, options.hidden_dims)
        )
        self.takes_turns = options.autoregressive and not specs.components.is_single
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.log_discrete_temperature = log_temperature(
            options.discrete_temperature, is_tuned=options.tune_discrete_temperature
        )
        self.log_parameter_temperature = log_temperature(
            options.parameter_temperature, is_tuned=options.tune_parameter_temperature
        )
        self.policy = HSACPolicy(self.actor, self.perception, specs)

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimizers by the names of what they learn."""
        options = self.options
        temperatures = [self.log_discrete_temperature, self.log_parameter_temperature]
        self.tunes_temperatures = any(temperature.requires_grad for temperature in temperatures)
        return {
            "actor": adam(options.actor_lr, self.actor),
            "critics": adam(options.critic_lr, self.critics, self.perception),
            "temperatures": torch.optim.Adam(temperatures, lr=options.temperature_lr, fused=True),
        }

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update the critics; every `policy_delay` updates, also the actor and the temperatures. Return scalars."""
        scalars = self.gradient_step("critics", self.critic_loss, sample)
        scalars["discrete_temperature"], scalars["parameter_temperature"] = self.temperatures()
        if self.updates % self.options.policy_delay == 0:
            stored = (sample["discrete"], sample["unit"]) if self.takes_turns else ()
            given = self.detached(sample), self.allowed(sample), self.fixed(sample), *stored
            scalars |= self.gradient_step("actor", self.actor_loss, *given)
            if self.tunes_temperatures:
                excesses = scalars["discrete_excess"], scalars["parameter_excess"]
                self.gradient_step("temperatures", self.temperature_loss, *excesses)
        polyak_update(self.target_critics, self.critics, self.options.tau)
        polyak_update(self.target_perception, self.perception, self.options.tau)
        return scalars

    def actor_loss(
        self, state: Tensor, allowed: Tensor | None, is_fixed: Tensor | None = None, *stored: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss that falls with the soft value, and the mean entropies minus their targets.

        Args:
            state: what actor and critics see, `[B, perception.specs.observation_dim]`.
            allowed: the discrete actions that may be taken, bool `[B, num_discrete]`; if None, all.
            is_fixed: the parameters that have a single value there, bool `[B, num_parameters]`; if None, none.
            stored: if components take turns, the discrete actions and the parameters that were executed there.
        """
        if stored:
            value, discrete_excess, parameter_excess = self.soft_value_in_turns(state, allowed, is_fixed, *stored)
        else:
            value, discrete_excess, parameter_excess = self.soft_value(self.critics, state, allowed, is_fixed)
        loss = -value.mean()
        excesses = {"discrete_excess": discrete_excess.mean(), "parameter_excess": parameter_excess.mean()}
        return loss, {"actor": loss, **excesses}

    def temperature_loss(self, discrete_excess: Tensor, parameter_excess: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss that lowers a temperature whose entropy exceeds the target, and raises it otherwise."""
        discrete_loss = self.log_discrete_temperature * discrete_excess
        return discrete_loss + self.log_parameter_temperature * parameter_excess, {}

    @torch.no_grad()
    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return the value of the most probable action by the target critics, `[B]`; the actor sees their features.

        It counts no entropy, which the greedy policy does not earn. Targets are the soft value V'(s).
        """
        observation = states.observation
        allowed, is_fixed = self.specs.allowed(observation, states.action_mask), self.specs.is_fixed(observation)
        features = self.target_perception.of_states(states)
        if is_target:
            return self.soft_value(self.target_critics, features, allowed, is_fixed)[0]
        discrete, raw = self.actor.most_probable(features, allowed, None)
        unit_parameters = zero_fixed(raw.tanh(), is_fixed)
        return self.target_critics.of_discrete(features, discrete, unit_parameters).amin(0)

    def soft_value(
        self,
        critics: HybridCritics | JointCritics,
        state: Tensor,
        allowed: Tensor | None = None,
        is_fixed: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the soft value V of states `[B, observation_dim]`, and both entropies minus their targets, each `[B]`.

        V = sum_k pi(k) [min Q(k, x_k) - a log pi(k) - b log pi(x_k)] with sampled x_k and temperatures a and b. The
        expectation over discrete actions is exact. The parameters' entropy is that of the executed action's own.

        Args:
            critics: give Q.
            state: what actor and critics see, `[B, perception.specs.observation_dim]`.
            allowed: the discrete actions that may be taken, bool `[B, num_discrete]`; if None, all.
            is_fixed: the parameters that have a single value there, bool `[B, num_parameters]`; if None, none. They
                have no entropy.
        """
        if isinstance(critics, JointCritics):
            return self.sampled_soft_value(critics, state, allowed, is_fixed)
        discrete_weight, parameter_weight = self.temperatures()
        distribution: HybridDistribution = self.actor(state, allowed)
        unit_parameters, log_density = distribution.sample_squashed()
        unit_parameters, log_density = zero_fixed(unit_parameters, is_fixed), zero_fixed(log_density, is_fixed)
        log_probs = distribution.discrete_log_probs
        # Of each discrete action's own parameters together, `[B, num_discrete]`.
        own_log_density = distribution.sum_of_own(log_density)
        dims = self.parameter_dims if is_fixed is None else distribution.sum_of_own((~is_fixed).float())
        own_target = self.options.parameter_target_entropy * dims
        q = critics(state, unit_parameters).amin(0) - discrete_weight * log_probs - parameter_weight * own_log_density
        probs = log_probs.exp()
        max_entropy = self.max_discrete_entropy if allowed is None else allowed.sum(-1).log()
        discrete_excess = -(probs * log_probs).sum(-1) - self.options.discrete_target_entropy * max_entropy
        parameter_excess = -(probs * (own_log_density + own_target)).sum(-1)
        return (probs * q).sum(-1), discrete_excess, parameter_excess

    def sampled_soft_value(
        self, critics: JointCritics, state: Tensor, allowed: Tensor | None, is_fixed: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the same as `soft_value`, from samples of actions with several components.

        The gradient of the value is that of its expectation; its number is the mean of the samples.
        """
        num, components = self.options.component_samples, self.specs.components
        discrete_weight, parameter_weight = self.temperatures()
        repeated, mask, fixed = (_repeated(rows, num) for rows in (state, allowed, is_fixed))
        discrete, raw, distribution = self.actor.act(HybridDistribution.sample, repeated, mask, None)
        discrete_log_prob, parameter_log_prob = (
            components.total(each) for each in self.log_probs(distribution, discrete, raw, fixed)
        )
        q = critics.of_discrete(repeated, discrete, zero_fixed(raw.tanh(), fixed)).amin(0)
        value = q - discrete_weight * discrete_log_prob - parameter_weight * parameter_log_prob
        each = value.detach().unflatten(0, (-1, num))
        baseline = (each.sum(-1, keepdim=True) - each) / (num - 1)
        score = discrete_log_prob * (each - baseline).flatten()
        value = value + score - score.detach()
        excesses = self.excesses(discrete_log_prob, parameter_log_prob, discrete, mask, fixed)
        value, discrete_excess, parameter_excess = (
            part.unflatten(0, (-1, num)).mean(-1) for part in (value, *excesses)
        )
        return value, discrete_excess, parameter_excess

    def soft_value_in_turns(
        self, state: Tensor, allowed: Tensor | None, is_fixed: Tensor | None, discrete: Tensor, unit: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the same as `soft_value` for an autoregressive actor whose components take turns.

        The batch is split among the n components: state i is the turn of component i mod n. The components before it
        keep what was executed there. The expectation over its own choices is exact, and the later components are
        sampled. So the value is that of going on from there, and each discrete head gets the gradient of its turns.

        Args:
            state: as for `soft_value`.
            allowed: as for `soft_value`.
            is_fixed: as for `soft_value`.
            discrete: what was executed, `[B, num_components]`.
            unit: its parameters, `[B, num_parameters]`.

        Returns:
            The values `[B]`, in the order of the turns, and both entropies minus their targets, from the states of the
            first component alone.
        """
        num = len(self.specs.components.sizes)

        def of_turn(rows: Tensor | None, number: int) -> Any:
            return None if rows is None else rows[number::num]

        rows = state, allowed, is_fixed, discrete, unit
        turns = [self._turn(number, *[of_turn(each, number) for each in rows]) for number in range(num)]
        return torch.cat([turn[0] for turn in turns]), turns[0][1], turns[0][2]

    def _turn(
        self,
        number: int,
        state: Tensor,
        allowed: Tensor | None,
        is_fixed: Tensor | None,
        discrete: Tensor,
        unit: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `soft_value_in_turns` does of the states in which this component has its turn."""
        assert isinstance(self.actor, AutoregressiveActor) and isinstance(self.critics, JointCritics)
        size = self.specs.components.sizes[number]
        discrete_weight, parameter_weight = self.temperatures()
        own = torch.arange(size, device=state.device).repeat(len(state))
        rows = state, allowed, is_fixed, discrete, unsquashed(unit, _LARGEST_EXECUTED)
        state, mask, fixed, discrete, raw = (_repeated(each, size) for each in rows)
        discrete, raw, distribution = self.actor.act_from(number, own, discrete, raw, state, mask)
        log_probs, densities = self.log_probs(distribution, discrete, raw, fixed)
        own_log_prob, later_log_prob = log_probs[:, number], log_probs[:, number + 1 :].detach().sum(-1)
        discrete_log_prob, parameter_log_prob = own_log_prob + later_log_prob, densities[:, number:].sum(-1)
        q = self.critics.of_discrete(state, discrete, zero_fixed(raw.tanh(), fixed)).amin(0)
        value = q - discrete_weight * discrete_log_prob - parameter_weight * parameter_log_prob
        excesses = self.excesses(discrete_log_prob, parameter_log_prob, discrete, mask, fixed)
        value, discrete_excess, parameter_excess = (
            (own_log_prob.exp() * part).unflatten(0, (-1, size)).sum(-1) for part in (value, *excesses)
        )
        return value, discrete_excess, parameter_excess

    def log_probs(
        self, distribution: HybridDistribution, discrete: Tensor, raw: Tensor, is_fixed: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return the log-likelihoods of discrete actions and of their squashed parameters, in the shape of `discrete`.

        Args:
            distribution: of the action.
            discrete: what was chosen, `[N, num_components]`, or `[N]` of a single component.
            raw: the parameters before they are squashed, `[N, num_parameters]`.
            is_fixed: the parameters that do not count, bool `[N, num_parameters]`; if None, all count.
        """
        standardised = (raw - distribution.mean) / distribution.log_scale.exp()
        log_density = gaussian_log_density(standardised, distribution.log_scale) - log_slope_of_tanh(raw)
        of_discrete = distribution.sum_of_own(zero_fixed(log_density, is_fixed))
        of_choice = self.specs.components.of_choice
        return of_choice(distribution.discrete_log_probs, discrete), of_choice(of_discrete, discrete)

    def excesses(
        self,
        discrete_log_prob: Tensor,
        parameter_log_prob: Tensor,
        discrete: Tensor,
        allowed: Tensor | None,
        is_fixed: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """Return samples of both entropies minus their targets, `[N]` each, of log-likelihoods `[N]`."""
        components = self.specs.components
        max_entropy: Tensor | float = self.max_discrete_entropy
        if allowed is not None:
            max_entropy = torch.stack([part.sum(-1) for part in allowed.split(components.sizes, -1)], -1).log().sum(-1)
        is_own = components.is_chosen(discrete).index_select(-1, self.owner)
        num_own = (is_own if is_fixed is None else is_own & ~is_fixed).sum(-1)
        discrete_excess = -discrete_log_prob - self.options.discrete_target_entropy * max_entropy
        return discrete_excess, -parameter_log_prob - self.options.parameter_target_entropy * num_own

    def temperatures(self) -> tuple[Tensor, Tensor]:
        """Return the weights of the discrete entropy and of the parameters' entropy, without gradients."""
        return self.log_discrete_temperature.detach().exp(), self.log_parameter_temperature.detach().exp()

    def on_progress(self, steps: int) -> None:
        """Explore with the actor from the end of the warm-up on."""
        self.policy.is_random.fill_(False)


def _repeated(rows: Tensor | None, num: int) -> Any:
    return None if rows is None else rows.repeat_interleave(num, 0)


def make_actor(specs: PAMDPSpecs, options: HSACOptions) -> HSACActor | HybridActor:
    """Return the actor for one component, or for several, which may see each other."""
    if specs.components.is_single and not options.autoregressive:
        return HSACActor(specs, options)
    settings: dict[str, Any] = {"initial_parameters": options.initial_parameters, "has_values": False}
    if options.autoregressive:
        return AutoregressiveActor(specs, options.hidden_dims, options.scale_range, bound=torch.tanh, **settings)
    return HybridActor(specs, options.hidden_dims, options.scale_range, **settings)


def log_temperature(initial: float, *, is_tuned: bool) -> nn.Parameter:
    """Return the logarithm of a temperature, with a gradient if it is tuned."""
    return nn.Parameter(torch.tensor(math.log(initial), dtype=torch.float32), requires_grad=is_tuned)
