"""TD3+BC for parameterised actions: P-DQN restricted to the data's discrete actions, with parameters near the data's.

Source: Fujimoto and Gu 2021, *A Minimalist Approach to Offline Reinforcement Learning*, arXiv 2106.06860, equation 5,
on the critics of MP-DQN (Bester et al. 2019, arXiv 1905.04388) with the twin critics, smoothing and delay of TD3
(Fujimoto et al. 2018, arXiv 1802.09477). Which discrete actions are allowed: discrete BCQ (Fujimoto et al. 2019, arXiv
1910.01708, equation in section 4).

Differs from the sources:
- Every discrete action has its own parameters. So the actor increases the values of all discrete actions, each weighted
  by its frequency in the data. The distance from the data is that of the recorded action's own parameters, summed over
  them; the source takes the mean. With n parameters the distance weighs n times as much.
- The actor increases the minimum of both critics, not the first one's value.
- States are not normalised, as problems scale their observations.
- By default the values weigh twice as much: `behaviour_weight`, which is 1 / alpha, is 0.2. The source has 0.4, from
  alpha = 2.5.
- The loss of the critics is the mean over both, in the source the sum. To Adam a constant factor is nearly the same.
- The noise in the target has a standard deviation of 0.05 and is clipped at 0.1. The source has 0.2 and 0.5.
- The learning rates are 1e-3, not 3e-4, and the hidden layers have 128 units, not 256.
- The model of the data's discrete actions has no penalty on its logits. In the code of discrete BCQ it has. There the
  learned critic chooses the next discrete action and the target values it; here the targets do both.
- With steps of its own it explores by Gaussian noise on the parameters. The source learns from data sets alone.

TorchRL's TD3BCLoss does not fit: its policy is a single bounded action leaf, without a discrete choice.
"""

from __future__ import annotations

import copy

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import States
from hpamdp.policies.low_level.td3_bc_options import CARDS, TD3BCOptions
from hpamdp.policies.masks import allowed_rows, masked_logits, zero_fixed
from hpamdp.policies.shared.exploration import with_exploring_noise
from hpamdp.policies.shared.gradients import adam
from hpamdp.policies.shared.networks import HybridCritics, mlp, polyak_update, with_clipped_noise
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.specs import PAMDPSpecs


class TD3BCPolicy(TensorDictModuleBase):
    """Takes the discrete action with the highest Q among the allowed ones; explores with noise on the parameters.

    A discrete action is allowed where the data takes it often enough.

    Args:
        actor: the parameters of all discrete actions, in [-1, 1].
        critics: the values of all discrete actions.
        behaviour: logits of the data's discrete actions.
        specs: sizes and bounds of the problem.
        options: settings of the learner.
    """

    def __init__(
        self,
        actor: nn.Module,
        critics: HybridCritics,
        behaviour: nn.Module,
        specs: PAMDPSpecs,
        options: TD3BCOptions,
    ) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        self.actor = actor
        self.critics = critics
        self.behaviour = behaviour
        self.specs = specs
        # In float32, and -inf where the threshold is 0.
        self.log_threshold = torch.tensor(options.discrete_threshold, dtype=torch.float32).log().item()
        self.parameter_noise = options.parameter_noise

    def is_refused(self, state: Tensor, allowed: Tensor | None) -> Tensor:
        """Return which discrete actions are forbidden or too rare in the data, bool `[B, num_discrete]`.

        Args:
            state: `[B, observation_dim]`.
            allowed: the discrete actions that may be taken, bool `[B, num_discrete]`; if None, all.
        """
        log_probs = masked_logits(self.behaviour(state), allowed).log_softmax(-1)
        is_rare = log_probs < log_probs.amax(-1, keepdim=True) + self.log_threshold
        return is_rare if allowed is None else is_rare | ~allowed

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the discrete action `[*B]` and the parameters `[*B, num_parameters]`."""
        state = td.get(keys.OBSERVATION).reshape(-1, self.specs.observation_dim)
        unit_parameters = zero_fixed(self.actor(state), self.specs.is_fixed(state))
        q = self.critics(state, unit_parameters).amin(0)
        discrete = q.masked_fill(self.is_refused(state, allowed_rows(self.specs, td)), -torch.inf).argmax(-1)
        if not is_greedy():
            unit_parameters = with_exploring_noise(unit_parameters, self.parameter_noise)
        td.set(keys.DISCRETE, discrete.reshape(td.batch_size))
        unit_parameters = unit_parameters.reshape((*td.batch_size, self.specs.num_parameters))
        return td.set(keys.PARAMETERS, self.specs.from_unit(unit_parameters, td))


class TD3BC(ReplayLearner):
    """Q-learning on the data's discrete actions with parameters near the data's, from a data set or a replay buffer."""

    Options = TD3BCOptions
    card = CARDS["TD3BC"]
    stores_own_parameters = True

    options: TD3BCOptions
    policy: TD3BCPolicy

    def make_networks(self, specs: PAMDPSpecs) -> None:
        """Make the networks and the policy."""
        options = self.options
        hidden_dims = options.hidden_dims
        self.actor = nn.Sequential(mlp(specs.observation_dim, hidden_dims, specs.num_parameters), nn.Tanh())
        self.critics = HybridCritics(specs, 2, hidden_dims, is_multipass=True)
        self.behaviour = mlp(specs.observation_dim, hidden_dims, specs.num_discrete)
        self.target_actor = copy.deepcopy(self.actor).requires_grad_(False)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = TD3BCPolicy(self.actor, self.critics, self.behaviour, specs, options)

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimizers by the names of what they learn."""
        options = self.options
        return {
            "actor": adam(options.actor_lr, self.actor),
            "critics": adam(options.critic_lr, self.critics),
            "behaviour": adam(options.actor_lr, self.behaviour),
        }

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update critics and behaviour; every `policy_delay` updates, also actor and targets. Return scalars."""
        allowed = self.allowed(sample)
        scalars = self.gradient_step("critics", self.critic_loss, sample)
        scalars |= self.gradient_step("behaviour", self.behaviour_loss, sample, allowed)
        if self.updates % self.options.policy_delay == 0:
            scalars |= self.gradient_step("actor", self.actor_loss, sample, allowed)
            polyak_update(self.target_actor, self.actor, self.options.tau)
            polyak_update(self.target_critics, self.critics, self.options.tau)
        return scalars

    def critic_loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the squared distance from the targets, and scalars."""
        q = self.critics.of_discrete(sample["state"], sample["discrete"], sample["unit"])
        loss = F.mse_loss(q, self.target(sample).expand_as(q))
        return loss, {"critic": loss, "q": q.mean()}

    def behaviour_loss(self, sample: TensorDictBase, allowed: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the negative log-likelihood of the data's discrete actions."""
        loss = F.cross_entropy(masked_logits(self.behaviour(sample["state"]), allowed), sample["discrete"])
        return loss, {"behaviour": loss}

    def actor_loss(self, sample: TensorDictBase, allowed: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss that falls towards higher values and towards the data."""
        state = sample["state"]
        unit_parameters = zero_fixed(self.actor(state), self.fixed(sample))
        with torch.no_grad():
            frequency = masked_logits(self.behaviour(state), allowed).softmax(-1)
        q = (self.critics(state, unit_parameters).amin(0) * frequency).sum(-1)
        is_own = self.owner == sample["discrete"].unsqueeze(-1)
        distance = ((unit_parameters - sample["unit"]).square() * is_own).sum(-1)
        # Values are divided by their mean size, so that the weight does not depend on the scale of the reward.
        loss = (self.options.behaviour_weight * distance).mean() - q.mean() / q.detach().abs().mean().clamp(min=1e-6)
        return loss, {"actor": loss}

    @torch.no_grad()
    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return max_k Q'(s, k, x'(s)) over the allowed discrete actions k, `[B]`.

        For targets, clipped noise is added to x'(s).
        """
        observation = states.observation
        smoothing = self.options.target_smoothing if is_target else 0.0
        clip = self.options.target_smoothing_clip
        unit_parameters = with_clipped_noise(self.target_actor(observation), smoothing, clip)
        unit_parameters = zero_fixed(unit_parameters, self.specs.is_fixed(observation))
        q = self.target_critics(observation, unit_parameters).amin(0)
        is_refused = self.policy.is_refused(observation, self.specs.allowed(observation, states.action_mask))
        return q.masked_fill(is_refused, -torch.inf).amax(-1)
