"""Behaviour cloning: maximum likelihood of the discrete actions and their own parameters in a data set.

Source: Pomerleau 1991, *Efficient Training of Artificial Neural Networks for Autonomous Navigation*; the policy is
H-PPO's (Fan et al. 2019, arXiv 1903.01344, section 4).

Differs from the source:
- Pomerleau's network has an output for each of 30 steering directions. Here discrete actions have a categorical
  distribution, and parameters have Gaussians, as in H-PPO.
- The optimizer is AdamW, with a weight decay of 0.01 by default.

TorchRL's BCLoss does not fit: it reads a single action leaf.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp.policies.low_level.bc_options import CARDS, BCOptions
from hpamdp.policies.shared.autoregressive_actor import AutoregressiveActor
from hpamdp.policies.shared.gradients import adam
from hpamdp.policies.shared.hybrid_actor import HybridActor, HybridPolicy
from hpamdp.policies.shared.options import ReplayOptions
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.specs import PAMDPSpecs


class BC(ReplayLearner):
    """Maximum-likelihood imitation; learns from data sets alone."""

    Options = BCOptions
    card = CARDS["BC"]
    stores_own_parameters = True

    def read_options(self, options: BCOptions | None, settings: Mapping[str, Any]) -> ReplayOptions:
        """Return the settings of the replay buffer; a data set alone fills it, so there is no warm-up."""
        self.imitation = options = BCOptions.of(options, settings)
        return ReplayOptions(buffer_size=options.buffer_size, batch_size=options.batch_size, warmup_steps=0)

    def make_networks(self, specs: PAMDPSpecs) -> None:
        """Make the actor and the policy."""
        options = self.imitation
        self.actor = (AutoregressiveActor if options.autoregressive else HybridActor)(
            specs, options.hidden_dims, options.scale_range
        )
        self.policy = HybridPolicy(self.actor, specs)

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimizer of the actor."""
        return {"actor": adam(self.imitation.lr, self.actor, weight_decay=self.imitation.weight_decay)}

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Make one step up the log-likelihood of transitions `[batch_size]`; return scalars."""
        return self.gradient_step("actor", self.loss, sample, self.allowed(sample))

    def loss(self, sample: TensorDictBase, allowed: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the negative log-likelihood of the data's actions, and scalars."""
        discrete, unit_parameters = sample["discrete"], sample["unit"]
        distribution = self.actor.given(sample["state"], discrete, unit_parameters, allowed, self.pairs(sample))
        log_probs = distribution.log_prob(discrete, unit_parameters)
        discrete_log_prob, parameter_log_prob = (self.specs.components.total(each) for each in log_probs)
        scalars = {"discrete_log_prob": discrete_log_prob.mean(), "parameter_log_prob": parameter_log_prob.mean()}
        return -(discrete_log_prob + parameter_log_prob).mean(), scalars

    def stored_losses(self) -> dict[str, Tensor]:
        """Return the negative log-likelihood of all stored actions, and its parts."""
        rows = self.with_all_parameters(self.buffer[:])
        loss, parts = self.loss(rows, self.allowed(rows))
        return {"loss": loss, **parts}
