"""Implicit Q-learning: the value of the better actions in the data, and a policy that imitates these.

V(s) is an upper expectile of Q(s, k, x) over the actions in the data. Q is fitted to r + gamma V(s'). The policy
maximises the log-likelihood of the data's actions, weighted by exp(temperature * (Q - V)). Q is never evaluated at an
action that is not in the data.

Source: Kostrikov, Nair and Levine 2021, *Offline Reinforcement Learning with Implicit Q-Learning*, arXiv 2110.06169,
equations 5 to 7.

Differs from the source:
- An action is a discrete action and its own parameters. So the policy is H-PPO's (Fan et al. 2019, arXiv 1903.01344). Q
  sees only the chosen action's own parameters, as in MP-DQN (Bester et al. 2019, arXiv 1905.04388).
- The policy's learning rate is constant. The source's code lets it fall along a cosine, within the million updates of a
  run: `actor_lr_updates=1000000`.
- The learning rates are 1e-3, not 3e-4, and the temperature is 10. The source has 3 on locomotion and 10 on mazes.
- The expectile is 0.8. The source has 0.7 on locomotion and 0.9 on mazes. Hidden layers have 128 units, not 256.
- The standard deviation depends on the state and lies between 0.02 and 1. In the source's code it does not depend on
  the state, its lower limit is exp(-5), and tanh bounds the means.
- The loss of the critics is the mean over both, in the source's code the sum.
- Critics and state value have PyTorch's initialisation. In the source's code all weights start orthogonal.
- Rewards are not normalised. The source's code scales those of locomotion by the range of the data's returns, and
  subtracts 1 on mazes.
- With steps of its own there is an update for every four steps. The source's code makes one for each step.

TorchRL's IQLLoss does not fit: it reads a single action leaf.
"""

from __future__ import annotations

import copy
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp.policies.base import States
from hpamdp.policies.low_level.iql_options import CARDS, IQLOptions
from hpamdp.policies.shared.autoregressive_actor import AutoregressiveActor
from hpamdp.policies.shared.exploration import schedule
from hpamdp.policies.shared.gradients import adam, expectile_loss, set_learning_rates
from hpamdp.policies.shared.hybrid_actor import HybridActor, HybridPolicy
from hpamdp.policies.shared.networks import HybridCritics, JointCritics, mlp, polyak_update
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.specs import PAMDPSpecs


class IQL(ReplayLearner):
    """Twin critics, a state value and an advantage-weighted policy, from a data set or a replay buffer."""

    Options = IQLOptions
    card = CARDS["IQL"]
    stores_own_parameters = True
    progress: ClassVar[frozenset[str]] = ReplayLearner.progress | {"actor_updates"}

    options: IQLOptions

    def make_networks(self, specs: PAMDPSpecs) -> None:
        """Make the networks and the policy."""
        options = self.options
        actor = AutoregressiveActor if options.autoregressive else HybridActor
        self.actor = actor(specs, options.hidden_dims, options.scale_range)
        self.state_value = mlp(specs.observation_dim, options.hidden_dims, 1)
        self.critics = (
            HybridCritics(specs, 2, options.hidden_dims, is_multipass=True)
            if specs.components.is_single
            else JointCritics(specs, 2, options.hidden_dims)
        )
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.policy = HybridPolicy(self.actor, specs)
        # Those of this run, for the schedule of the learning rate.
        self.actor_updates: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimizers by the names of what they learn."""
        options = self.options
        return {
            "actor": adam(options.actor_lr, self.actor),
            "state_value": adam(options.critic_lr, self.state_value),
            "critics": adam(options.critic_lr, self.critics),
        }

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Update V, then Q, then the policy from transitions `[batch_size]`; return scalars."""
        with torch.no_grad():
            q = self.target_critics.of_discrete(sample["state"], sample["discrete"], sample["unit"]).amin(0)
        of_value = self.gradient_step("state_value", self.value_loss, sample["state"], q)
        scalars = self.gradient_step("critics", self.critic_loss, sample) | of_value | {"q": q.mean()}
        polyak_update(self.target_critics, self.critics, self.options.tau)
        if self.options.actor_lr_updates > 0:
            fraction = schedule(int(self.actor_updates), self.options.actor_lr_updates, 0.0, "cosine")
            set_learning_rates(self.optimizers, {"actor": self.options.actor_lr}, fraction)
            self.actor_updates += 1
        return scalars | self.gradient_step("actor", self.actor_loss, sample, self.allowed(sample), q)

    def value_loss(self, state: Tensor, q: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the distance of V from the expectile of the values `[B]` of the data's actions."""
        excess = q - self.state_value(state).squeeze(-1)
        loss = expectile_loss(excess, self.options.expectile)
        return loss, {"value": loss}

    def critic_loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the squared distance from the targets."""
        q = self.critics.of_discrete(sample["state"], sample["discrete"], sample["unit"])
        loss = F.mse_loss(q, self.target(sample).expand_as(q))
        return loss, {"critic": loss}

    def actor_loss(self, sample: TensorDictBase, allowed: Tensor | None, q: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the negative log-likelihood of the data's actions, weighted by their advantages."""
        with torch.no_grad():
            advantage = q - self.state_value(sample["state"]).squeeze(-1)
            weight = (self.options.temperature * advantage).exp().clamp(max=self.options.max_weight)
        discrete, unit_parameters = sample["discrete"], sample["unit"]
        distribution = self.actor.given(sample["state"], discrete, unit_parameters, allowed, self.pairs(sample))
        log_probs = distribution.log_prob(discrete, unit_parameters)
        discrete_log_prob, parameter_log_prob = (self.specs.components.total(each) for each in log_probs)
        loss = -(weight * (discrete_log_prob + parameter_log_prob)).mean()
        return loss, {"advantage_weight": weight.mean()}

    def value(self, states: States, *, is_target: bool = False) -> Tensor:
        """Return V(s), `[B]`."""
        return self.state_value(states.observation).squeeze(-1)
