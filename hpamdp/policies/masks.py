"""Choose among the discrete actions, or the options, that a mask allows.

A mask is bool `[*B, K]`, True where a choice is allowed; None allows everything and changes nothing.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.specs import PAMDPSpecs

# Of a forbidden choice: its probability is exactly 0, while entropies and gradients stay finite.
_FORBIDDEN_LOGIT = -1e9


def sample_index(logits: Tensor) -> Tensor:
    """Sample an index from the softmax of logits `[*B, K]`, int64 `[*B]`."""
    # The Gumbel-max trick: faster than torch.multinomial, and works for any batch shape.
    return (logits - torch.empty_like(logits).exponential_().log()).argmax(-1)


def masked_logits(logits: Tensor, mask: Tensor | None) -> Tensor:
    """Return logits `[*B, K]` whose softmax is 0 for forbidden choices."""
    return logits if mask is None else logits.masked_fill(~mask, _FORBIDDEN_LOGIT)


def masked_values(values: Tensor, mask: Tensor | None) -> Tensor:
    """Return values `[*B, K]` whose maximum is that of the allowed choices: forbidden ones are -inf."""
    return values if mask is None else values.masked_fill(~mask, -torch.inf)


def random_choice(shape: torch.Size, num: int, mask: Tensor | None, device: torch.device) -> Tensor:
    """Return uniformly random choices of `num`, int64 `shape`, allowed ones where there is a mask `[*shape, num]`."""
    if mask is None:
        return torch.randint(num, shape, device=device)
    return sample_index(masked_logits(torch.zeros_like(mask, dtype=torch.float32), mask))


def allowed_or_first(choice: Tensor, mask: Tensor) -> Tensor:
    """Return the choices `[*B]`, and the first allowed one where they are forbidden."""
    is_allowed = mask.gather(-1, choice.unsqueeze(-1)).squeeze(-1)
    return torch.where(is_allowed, choice, mask.to(torch.int8).argmax(-1))


def allowed_rows(specs: PAMDPSpecs, td: TensorDictBase) -> Tensor | None:
    """Return which discrete actions may be taken in the states of a step `[*B]`, bool `[N, num_discrete]`; None: all.

    N is the number of its rows, one after another.
    """
    mask = specs.allowed(td.get(keys.OBSERVATION), td.get(keys.ACTION_MASK, None))
    return None if mask is None else mask.reshape(-1, specs.num_discrete)
