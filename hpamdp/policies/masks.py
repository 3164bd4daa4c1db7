"""Choose among the discrete actions, or the options, that a mask allows.

A mask is bool `[*B, K]` and true where a choice is allowed. If a mask is None, every choice is allowed.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.specs import PAMDPSpecs

# A choice with this logit has probability 0, whatever the other logits are. Entropies and gradients stay finite.
_FORBIDDEN_LOGIT = -1e30


def sample_index(logits: Tensor) -> Tensor:
    """Sample an index from the softmax of logits `[*B, K]`, int64 `[*B]`."""
    # The Gumbel-max trick: faster than torch.multinomial, and works for any batch shape.
    return (logits - torch.empty_like(logits).exponential_().log()).argmax(-1)


def masked_logits(logits: Tensor, mask: Tensor | None) -> Tensor:
    """Return logits `[*B, K]` whose softmax is 0 for forbidden choices."""
    return logits if mask is None else logits.masked_fill(~mask, _FORBIDDEN_LOGIT)


def masked_values(values: Tensor, mask: Tensor | None) -> Tensor:
    """Return values `[*B, K]` that are -inf for forbidden choices."""
    return values if mask is None else values.masked_fill(~mask, -torch.inf)


def random_choice(shape: torch.Size, num: int, mask: Tensor | None, device: torch.device) -> Tensor:
    """Return uniformly random choices below `num`, int64 `shape`; with a mask `[*shape, num]`, allowed ones."""
    if mask is None:
        return torch.randint(num, shape, device=device)
    return sample_index(masked_logits(torch.zeros_like(mask, dtype=torch.float32), mask))


def random_discrete(
    specs: PAMDPSpecs, shape: torch.Size, mask: Tensor | None, device: torch.device, pair_mask: Tensor | None = None
) -> Tensor:
    """Return uniformly random discrete actions, int64 `[*shape]`, or `[*shape, num_components]`.

    With a `pair_mask`, each component chooses uniformly among what the components before it leave.

    Args:
        specs: of the problem.
        shape: of the states.
        mask: the discrete actions that may be taken, bool `[*shape, num_discrete]`; if None, all.
        device: where to draw.
        pair_mask: the discrete actions that go together, bool `[*shape, num_discrete, num_discrete]`; if None, all.
    """
    components = specs.components
    if components.is_single:
        return random_choice(shape, specs.num_discrete, mask, device)
    is_chosen = torch.zeros(*shape, specs.num_discrete, dtype=torch.bool, device=device)
    drawn = []
    for number, (start, size) in enumerate(zip(components.starts, components.sizes, strict=True)):
        allowed = components.allowed_next(number, is_chosen, mask, pair_mask)
        choice = random_choice(shape, size, allowed, device)
        drawn.append(choice)
        is_chosen[..., start : start + size] = torch.arange(size, device=device) == choice.unsqueeze(-1)
    return torch.stack(drawn, -1)


def random_action(specs: PAMDPSpecs, td: TensorDictBase) -> TensorDictBase:
    """Write a uniformly random allowed action: discrete `[*B]` and parameters `[*B, num_parameters]`."""
    device = td.get(keys.OBSERVATION).device
    unit_parameters = 2.0 * torch.rand(*td.batch_size, specs.num_parameters, device=device, dtype=torch.float32) - 1.0
    allowed = specs.allowed(td.get(keys.OBSERVATION), td.get(keys.ACTION_MASK, None))
    discrete = random_discrete(specs, td.batch_size, allowed, device, td.get(keys.PAIR_MASK, None))
    parameters = specs.from_unit(unit_parameters, td)
    return td.update({keys.ACTION: {"discrete": discrete, "parameters": parameters}})


def zero_fixed(values: Tensor, is_fixed: Tensor | None) -> Tensor:
    """Return values `[*B, num_parameters]`, set to 0 where the state leaves a parameter a single value.

    Such parameters are stored as 0, so critics have seen no other number.

    Args:
        values: one for each parameter, such as the parameters in [-1, 1] or their log densities.
        is_fixed: see `PAMDPSpecs.is_fixed`. If None, no parameter is.
    """
    return values if is_fixed is None else values.masked_fill(is_fixed, 0.0)


def allowed_or_first(choice: Tensor, mask: Tensor) -> Tensor:
    """Return the choices `[*B]`, or the first allowed choice where one is forbidden."""
    is_allowed = mask.gather(-1, choice.unsqueeze(-1)).squeeze(-1)
    return torch.where(is_allowed, choice, mask.to(torch.int8).argmax(-1))


def allowed_rows(specs: PAMDPSpecs, td: TensorDictBase) -> Tensor | None:
    """Return which discrete actions may be taken in the N states of a step `[*B]`, bool `[N, num_discrete]`.

    None if all of them may be taken everywhere.
    """
    mask = specs.allowed(td.get(keys.OBSERVATION), td.get(keys.ACTION_MASK, None))
    return None if mask is None else mask.reshape(-1, specs.num_discrete)
