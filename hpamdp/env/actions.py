"""Validation of the values of batched actions."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hpamdp.components import Components
from hpamdp.messages import invalid_action


def check_action_values(
    discrete: Tensor, parameters: Tensor, parameter_dims: Sequence[int], components: Components
) -> None:
    """Check that each discrete action exists and that its own parameters are finite.

    Args:
        discrete: integers `[N]`, or `[N, num_components]`.
        parameters: float `[N, sum(parameter_dims)]`, the parameters of all discrete actions side by side.
        parameter_dims: number of parameters of each discrete action.
        components: components of the action.

    Raises:
        ValueError: an action is invalid; the message names the first such environment.
    """
    device = discrete.device
    owner = torch.arange(len(parameter_dims), device=device)
    owner = owner.repeat_interleave(torch.tensor(parameter_dims, device=device))
    is_own = components.is_chosen(discrete).index_select(-1, owner)
    is_valid = components.exists(discrete) & (parameters.isfinite() | ~is_own).all(-1)
    if not is_valid.all():
        row = int((~is_valid).nonzero()[0])
        allowed = " and ".join(f"0 to {size - 1}" for size in components.sizes)
        raise invalid_action(
            row,
            {
                "discrete": (discrete[row].tolist(), f"allowed {allowed}"),
                "parameters": (parameters[row].tolist(), "those of the chosen action must be finite"),
            },
        )
