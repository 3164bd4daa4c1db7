"""Behaviour cloning: the likeliest press in the data, by maximum likelihood of keys and durations.

Source: Pomerleau 1991, *Efficient Training of Artificial Neural Networks for Autonomous Navigation*; the policy is
H-PPO's (Fan et al. 2019, arXiv 1903.01344, section 4).
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp.policies.shared.hybrid_actor import HybridActor, HybridPolicy
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.specs import PAMDPSpecs


class BC(ReplayLearner):
    """Maximum likelihood of the data's presses; learns from data sets alone.

    Args:
        specs: of the problem.
        device: where the network lives.
        hidden_dims: of the actor.
        min_scale, max_scale: range of the Gaussian's deviation, in units where the bounds are [-1, 1].
        buffer_size: transitions that are kept.
        batch_size, lr, weight_decay: of the updates.
    """

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
        lr: PositiveFloat,
        weight_decay: NonNegativeFloat,
    ) -> None:
        if not min_scale < max_scale:
            raise ValueError(f"min_scale={min_scale}: must be less than {max_scale=}")
        super().__init__(
            specs,
            device,
            gamma=1.0,
            warmup_frames=0,
            buffer_size=buffer_size,
            batch_size=batch_size,
            updates_per_frame=0.0,
        )
        self.actor = HybridActor(specs, hidden_dims, (min_scale, max_scale), (min_scale * max_scale) ** 0.5)
        self.policy = HybridPolicy(self.actor, specs)
        self.to(device)
        adam = torch.optim.AdamW(self.actor.parameters(), lr=lr, weight_decay=weight_decay, fused=True)
        self.optimizers = {"actor": adam}

    def train_step(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Take a step up the likelihood of transitions `[batch_size]`."""
        of_discrete, of_parameters = self.actor(sample["state"]).log_prob(sample["discrete"], sample["unit"])
        self.optimizer_step("actor", -(of_discrete + of_parameters).mean())
        return {"discrete_log_prob": of_discrete.mean(), "parameter_log_prob": of_parameters.mean()}
