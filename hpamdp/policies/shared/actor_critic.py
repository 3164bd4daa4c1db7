"""Settings that actor-critic learners share, each group with what is computed from it."""

from __future__ import annotations

from collections.abc import Mapping

import torch


def set_learning_rates(
    optimizers: Mapping[str, torch.optim.Optimizer], rates: Mapping[str, float], fraction: float
) -> None:
    """Set the learning rate of each optimizer to a fraction of the rate of the same name."""
    for name, rate in rates.items():
        for group in optimizers[name].param_groups:
            group["lr"] = rate * fraction
