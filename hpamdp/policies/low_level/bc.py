"""Behaviour cloning: maximum likelihood of the discrete actions and their own parameters in a data set.

Source: Pomerleau 1991, *Efficient Training of Artificial Neural Networks for Autonomous Navigation*; the policy is
H-PPO's (Fan et al. 2019, arXiv 1903.01344, section 4).

TorchRL's BCLoss does not fit: it reads a single action leaf.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp.policies.shared.hybrid_actor import HybridActor, HybridDistribution, HybridPolicy
from hpamdp.policies.shared.replay import ReplayLearner, ReplayOptions
from hpamdp.settings import LearningRate
from hpamdp.specs import PAMDPSpecs


class BC(ReplayLearner):
    """Maximum-likelihood imitation; learns from data sets alone.

    Args:
        specs: sizes and bounds of the problem.
        device: where the network lives.
        hidden_dims: sizes of the actor's hidden layers.
        min_scale, max_scale: range of the Gaussian's standard deviation, in units where the bounds are [-1, 1].
        buffer_size: largest number of transitions that are kept.
        batch_size: transitions in an update.
        lr: learning rate.
        weight_decay: of AdamW.
    """

    stores_own_parameters = True
    modes: ClassVar[tuple[str, ...]] = ("offline",)

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        hidden_dims: Annotated[list[PositiveInt], Field(min_length=1)],
        min_scale: PositiveFloat,
        max_scale: PositiveFloat,
        buffer_size: PositiveInt,
        batch_size: PositiveInt,
        lr: LearningRate,
        weight_decay: NonNegativeFloat,
    ) -> None:
        if not min_scale < max_scale:
            raise ValueError(f"min_scale={min_scale}: must be less than {max_scale=}")
        options = ReplayOptions(
            gamma=1.0,
            warmup_steps=0,
            buffer_size=buffer_size,
            batch_size=batch_size,
            updates_per_step=1.0,
        )
        super().__init__(specs, device, options)
        self.actor = HybridActor(specs, hidden_dims, (min_scale, max_scale), (min_scale * max_scale) ** 0.5)
        self.policy = HybridPolicy(self.actor, specs)
        self.to(device)
        optimizer = torch.optim.AdamW(self.actor.parameters(), lr=lr, weight_decay=weight_decay, fused=True)
        self.optimizers = {"actor": optimizer}

    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Make one step up the log-likelihood of transitions `[batch_size]`; return scalars."""
        return self.gradient_step("actor", self._loss, sample, self.allowed(sample))

    def _loss(self, sample: TensorDictBase, allowed: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        distribution: HybridDistribution = self.actor(sample["state"], allowed)
        discrete_log_prob, parameter_log_prob = distribution.log_prob(sample["discrete"], sample["unit"])
        scalars = {"discrete_log_prob": discrete_log_prob.mean(), "parameter_log_prob": parameter_log_prob.mean()}
        return -(discrete_log_prob + parameter_log_prob).mean(), scalars
