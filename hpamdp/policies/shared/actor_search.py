"""What P-DQN and HyAR share: a deterministic actor that also follows the best of the actions that its critics value.

The gradient of the critics alone stays on the hill that the actor began on. So the actor's loss may also draw it to the
best of random actions. The greedy policy may choose among variations of the actor's actions.

Source: Neumann et al. 2023, *Greedy Actor-Critic*, arXiv 1810.09103 (towards the best of random actions); Andrychowicz
et al. 2017, arXiv 1707.01495, appendix A (penalty on preactivations).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from hpamdp.policies.shared.options import (
    SearchingActorOptions,
)
from hpamdp.settings import SettingError


def searching_actor_loss(
    options: SearchingActorOptions, value: Tensor, raw: Tensor, search: Callable[[], tuple[Tensor, Tensor]]
) -> Tensor:
    """Return the loss of an actor, a scalar.

    Args:
        options: weights of its parts.
        value: of the actor's actions, `[B]`.
        raw: its preactivations, `[B, ...]`.
        search: returns by how much better actions were found, and the squared distances to them, `[B, N]` each.
    """
    loss = -value.mean()
    if options.preactivation_penalty > 0.0:
        loss = loss + options.preactivation_penalty * raw.square().flatten(1).sum(-1).mean()
    if options.search_samples > 0 and options.search_weight > 0.0:
        gain, distance = search()
        loss = loss + options.search_weight * (gain * distance).sum(-1).mean()
    return loss


def even_normal(num: int, dim: int, deviation: float) -> Tensor:
    """Return normal vectors `[num, dim]` with mean 0 that cover the space evenly, the same at each call.

    Raises:
        ValueError: there are too many dimensions.
    """
    if num == 0 or dim == 0:
        return torch.zeros(num, dim, dtype=torch.float32)
    if dim > SobolEngine.MAXDIM:
        raise SettingError(
            f"greedy_samples={num}: {dim} parameters are more than {SobolEngine.MAXDIM}; use greedy_samples=0"
        )
    uniform = SobolEngine(dim, scramble=True, seed=0).draw(num, dtype=torch.float32)
    return deviation * torch.special.ndtri(uniform.clamp(1e-6, 1.0 - 1e-6))


def with_variations(unit_actions: Tensor, variations: Tensor) -> Tensor:
    """Return actions in [-1, 1], `[*B, D]`, and behind each its sums with the variations `[S, D]`: `[*B, 1 + S, D]`."""
    unit_actions = unit_actions.unsqueeze(-2)
    return torch.cat([unit_actions, (unit_actions + variations).clamp(-1.0, 1.0)], -2)


def in_pieces(function: Callable[..., tuple[Tensor, ...]], num_rows: int, *rows: Tensor) -> tuple[Tensor, ...]:
    """Return what a function makes of rows, each `[N, ...]`, given to it `num_rows` at a time: bounds the memory."""
    if rows[0].shape[0] <= num_rows:
        return function(*rows)
    pieces = [function(*piece) for piece in zip(*(each.split(num_rows) for each in rows), strict=True)]
    return tuple(torch.cat(made) for made in zip(*pieces, strict=True))
