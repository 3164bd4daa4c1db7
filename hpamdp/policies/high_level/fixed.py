"""The same option at every decision."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.policies.high_level.options import CARDS, FixedOptions
from hpamdp.policies.masks import allowed_or_first
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs


class Fixed(Selector):
    """Choose the same option at every decision; if it is forbidden, the first allowed one.

    Raises:
        SettingError: the problem has no such option.
    """

    Options = FixedOptions
    card = CARDS["Fixed"]

    def __init__(self, specs: PAMDPSpecs, options: FixedOptions | None = None, **settings: Any) -> None:
        super().__init__(specs)
        self.options: FixedOptions = FixedOptions.of(options, settings)
        option = self.options.option
        names = specs.option_names
        if option not in names and option not in range(specs.num_options):
            raise SettingError(f"option={option}: no such option; there are {', '.join(names)}")
        self.option = names.index(option) if isinstance(option, str) else option

    def select(self, td: TensorDictBase) -> Tensor:
        """Return the option for every environment, int64 `[*B]`."""
        option = torch.full_like(td.get(keys.IS_DECISION).squeeze(-1), self.option, dtype=torch.long)
        mask = td.get(keys.OPTION_MASK, None)
        return option if mask is None else allowed_or_first(option, mask)
