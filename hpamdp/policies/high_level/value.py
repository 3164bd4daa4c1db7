"""The option with the highest value by its learner's own estimate. The selector itself learns nothing.

A learner's critic, or its plan in a learned model, predicts the value of a state under each option before any option
was chosen there. Bandits need thousands of decisions to learn as much.

Source: the greedy policy over option values of Sutton, Precup and Singh 1999, *Between MDPs and semi-MDPs*, Artificial
Intelligence 112. While exploring, the value of PETS without `end_values` is that of a random member of its ensemble.
That makes the choice posterior sampling over options: Osband, Russo and Van Roy 2013, arXiv 1306.0940.

Differs from the source: while exploring, options whose learner has made no update come first, in random order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import Selector
from hpamdp.policies.masks import masked_values, random_choice
from hpamdp.settings import Fraction, Settings
from hpamdp.specs import PAMDPSpecs


class ValueOptions(Settings):
    """Settings of `Value`."""

    epsilon: Fraction = 0.05
    """Probability of a random option while exploring."""


class Value(Selector):
    """Choose the option with the highest value; while exploring, some options are random."""

    Options = ValueOptions
    asks_learners = True
    takes_pictures = True

    def __init__(self, specs: PAMDPSpecs, options: ValueOptions | None = None, **settings: Any) -> None:
        super().__init__(specs)
        self.options: ValueOptions = ValueOptions.of(options, settings)
        if specs.has_action_mask:
            self.in_keys.append(keys.ACTION_MASK)

    def select(self, td: TensorDictBase) -> Tensor:
        """Return an option for every environment, int64 `[*B]`; 0 if no decision is due or the episode has ended."""
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        done = td.get(keys.DONE, None)
        if done is not None:  # evaluations also step episodes that have ended, and planning for them takes time
            is_decision = is_decision & ~done.squeeze(-1)
        option = torch.zeros_like(is_decision, dtype=torch.long)
        if not is_decision.any():
            return option
        action_mask, option_mask = (
            None if mask is None else mask[is_decision]
            for mask in (td.get(keys.ACTION_MASK, None), td.get(keys.OPTION_MASK, None))
        )
        value = self._values(td.get(keys.OBSERVATION)[is_decision], action_mask, option_mask)
        if is_greedy():
            best = value.argmax(-1)
        else:
            is_best = value == value.amax(-1, keepdim=True)
            best = torch.where(is_best, torch.rand_like(value), -1.0).argmax(-1)  # break ties at random
            is_random = torch.rand(best.shape, device=best.device, dtype=torch.float32) < self.options.epsilon
            random_option = random_choice(best.shape, self.specs.num_options, option_mask, best.device)
            best = torch.where(is_random, random_option, best)
        option[is_decision] = best
        return option

    def greedy_choice(self) -> Callable[[TensorDictBase], Tensor]:
        """Return the choice of the allowed option with the highest value, whether or not a decision is due."""
        names = keys.OBSERVATION, keys.ACTION_MASK, keys.OPTION_MASK
        return lambda td: self._values(*(td.get(name, None) for name in names)).argmax(-1)

    def _values(self, observation: Tensor, action_mask: Tensor | None, option_mask: Tensor | None) -> Tensor:
        """Return the value of each option, `[N, num_options]`, -inf where it is forbidden."""
        return masked_values(self.option_values(observation, action_mask), option_mask)
