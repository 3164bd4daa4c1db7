"""The same option at every decision."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.policies.masks import allowed_or_first
from hpamdp.specs import PAMDPSpecs


class Fixed(Selector):
    """Choose the same option at every decision; the first allowed one where it is forbidden.

    Args:
        specs: of the problem.
        option: name or number of the option.

    Raises:
        ValueError: the problem has no such option.
    """

    def __init__(self, specs: PAMDPSpecs, *, option: str | int) -> None:
        super().__init__(specs)
        names = specs.option_names
        if option not in names and option not in range(specs.num_options):
            raise ValueError(f"option={option}: no such option; there are {', '.join(names)}")
        self.option = names.index(option) if isinstance(option, str) else option

    def select(self, td: TensorDictBase) -> Tensor:
        """Return the option for every environment, int64 `[*B]`."""
        option = torch.full_like(td.get(keys.IS_DECISION).squeeze(-1), self.option, dtype=torch.long)
        mask = td.get(keys.OPTION_MASK, None)
        return option if mask is None else allowed_or_first(option, mask)
