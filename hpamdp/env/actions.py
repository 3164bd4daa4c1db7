"""Validation of the values of actions, with one wording of the error for all environments."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hpamdp.messages import invalid_action


def check_action_values(
    discrete: Tensor,
    parameters: Tensor,
    parameter_dims: Sequence[int],
    *,
    names: tuple[str, str] = ("discrete", "parameters"),
) -> None:
    """Check that each discrete action exists and that its own parameters are finite.

    Args:
        discrete: integers `[N]`.
        parameters: float `[N, sum(parameter_dims)]`, the parameters of all discrete actions side by side.
        parameter_dims: number of parameters of each discrete action.
        names: what the error calls `discrete` and `parameters`.

    Raises:
        ValueError: an action is invalid; the message names the first such environment.
    """
    num_discrete = len(parameter_dims)
    indices = torch.arange(num_discrete, device=discrete.device)
    owner = indices.repeat_interleave(torch.tensor(parameter_dims, device=discrete.device))
    is_own = owner == discrete.unsqueeze(-1)
    is_valid = (discrete >= 0) & (discrete < num_discrete) & (parameters.isfinite() | ~is_own).all(-1)
    if not is_valid.all():
        row = int((~is_valid).nonzero()[0])
        discrete_name, parameters_name = names
        raise invalid_action(
            row,
            {
                discrete_name: (discrete[row].item(), f"allowed 0 to {num_discrete - 1}"),
                parameters_name: (parameters[row].tolist(), "those of the chosen action must be finite"),
            },
        )
