"""Settings that actor-critic learners share, each group with what is computed from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveInt

from hpamdp.policies.shared.replay import ReplayOptions
from hpamdp.settings import LearningRate, OnlyWith, OwnSteps, PositiveFraction, Settings, Widths


class ActorCriticOptions(ReplayOptions):
    """Settings of an actor and its critics, which learn from a replay buffer."""

    hidden_dims: Widths = (128, 128)
    """Hidden layers of the actor and of the critics."""
    actor_lr: LearningRate = 1e-3
    """Learning rate of the actor."""
    critic_lr: LearningRate = 1e-3
    """Learning rate of the critics."""


class TargetRateOptions(Settings):
    """How fast target networks follow the learned networks."""

    tau: PositiveFraction = 0.01
    """Fraction of the way to the learned networks that the target networks move in an update of theirs."""


class SmoothedTargetOptions(Settings):
    """Target policy smoothing and the delayed actor of TD3 (Fujimoto, van Hoof and Meger 2018, arXiv 1802.09477)."""

    target_smoothing: NonNegativeFloat = 0.1
    """Standard deviation of the noise on the target actor's output, in units where its bounds are [-1, 1]."""
    target_smoothing_clip: Annotated[NonNegativeFloat, OnlyWith("target_smoothing")] = 0.2
    """Largest size of this noise."""
    policy_delay: PositiveInt = 2
    """Critic updates for each update of the actor."""


class TwinCriticOptions(SmoothedTargetOptions):
    """The three changes that turn DDPG into TD3."""

    twin: bool = True
    """Learn two critics and use the lower of their values. A single critic overestimates."""


class AnnealedRateOptions(Settings):
    """Learning rates that fall linearly."""

    lr_final_fraction: Annotated[PositiveFraction, OwnSteps()] = 1.0
    """Fraction of the learning rates that is left after `lr_steps`; 1 keeps them constant."""
    lr_steps: Annotated[NonNegativeInt, OwnSteps()] = 100_000
    """The learner's own steps, after its warm-up, within which the learning rates fall.

    With `mode=offline` the learner makes no steps of its own, so the rates stay constant.
    """


def set_learning_rates(
    optimizers: Mapping[str, torch.optim.Optimizer], rates: Mapping[str, float], fraction: float
) -> None:
    """Set the learning rate of each optimizer to a fraction of the rate of the same name."""
    for name, rate in rates.items():
        for group in optimizers[name].param_groups:
            group["lr"] = rate * fraction
