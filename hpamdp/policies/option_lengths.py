"""Let a selector choose an option together with its length: it chooses among their pairs as among options.

Source: Henaff, Fujimoto, Matthews and Rabbat 2025, *Scalable Option Learning in High-Throughput Environments*, arXiv
2509.00338, whose high level chooses an option and a power of two, up to 128, as its length.

Differs from the source:
- every pair has its own logit or value. The high level of the source has one output for the option and one for the
  length;
- lengths are a setting, and any selector that learns from decisions can choose them;
- an option ends earlier if none of its actions is allowed any more;
- values are discounted for each step of an option. The source adds up the rewards of an option without a discount, and
  discounts the next decision once.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.policies.base import Selector

# The lengths of the source, if `agent.option_lengths` is not set.
DEFAULT_LENGTHS = (1, 2, 4, 8, 16, 32, 64, 128)


class OptionLengths(nn.Module):
    """The lengths that a selector may choose, and the number of each pair of an option and a length.

    Pair `option * len(lengths) + i` is the option for `lengths[i]` steps. The selector sees the number of the pair
    under `option`, and `option_mask` has an entry for each pair. The rest of the agent, the environment and the
    learners see `option` and `option_length`.

    Args:
        lengths: numbers of steps, positive and increasing.
    """

    def __init__(self, lengths: Sequence[int]) -> None:
        super().__init__()
        self.longest = max(lengths)
        # Not persistent, since the lengths are a setting, which the checkpoint already holds.
        self.lengths = nn.Buffer(torch.tensor(lengths, dtype=torch.long), persistent=False)

    def extra_repr(self) -> str:
        """Return the lengths as text."""
        return str(self.lengths.tolist())

    def with_pairs(self, rows: TensorDictBase) -> TensorDictBase:
        """Return a shallow copy of steps or decisions `[*B]` in the form that the selector sees."""
        rows = rows.copy()
        option, length = rows.get(keys.OPTION, None), rows.get(keys.OPTION_LENGTH, None)
        if option is not None and length is not None:
            rows.set(keys.OPTION, option * len(self.lengths) + torch.searchsorted(self.lengths, length))
        elif option is not None:  # an option without a length is no pair that the selector could hold
            rows = rows.exclude(keys.OPTION)
        for name in (keys.OPTION_MASK, ("next", keys.OPTION_MASK)):
            mask = rows.get(name, None)
            if mask is not None:
                rows.set(name, mask.repeat_interleave(len(self.lengths), -1))
        return rows

    def split(self, pair: Tensor) -> tuple[Tensor, Tensor]:
        """Return the options and the lengths of pairs, int64 `[*B]` each."""
        option = pair.div(len(self.lengths), rounding_mode="floor")
        return option, self.lengths[pair.remainder(len(self.lengths))]


class PairSelector(TensorDictModuleBase):
    """The high level's policy if the selector chooses pairs: it writes `option` and `option_length`.

    Args:
        selector: chooses among the pairs.
        pairs: numbers the pairs.
    """

    def __init__(self, selector: Selector, pairs: OptionLengths) -> None:
        super().__init__()
        self.selector = selector
        self.pairs = pairs
        self.in_keys = list(selector.in_keys)
        self.out_keys = [*selector.out_keys, keys.OPTION_LENGTH]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the selector's `out_keys`, with the option in place of the pair, and `option_length` int64 `[*B]`."""
        chosen = self.selector(self.pairs.with_pairs(td)).select(*self.selector.out_keys)
        option, length = self.pairs.split(chosen.get(keys.OPTION))
        return td.update(chosen).update({keys.OPTION: option, keys.OPTION_LENGTH: length})
