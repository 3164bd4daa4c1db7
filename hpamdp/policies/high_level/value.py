"""The option that the learners themselves expect most of: there is nothing for the selector to learn.

A critic, or a plan in a learned model, tells the value of a state under each option before any of them has been chosen
there. Bandits need thousands of decisions to learn as much. In a hierarchy it is the greedy policy over option values:
Sutton, Precup and Singh 1999, *Between MDPs and semi-MDPs*, Artificial Intelligence 112. A learner such as PETS without
`end_values`, whose value is that of a random member of its ensemble when exploring, makes it posterior sampling over
options: Osband, Russo and Van Roy 2013, arXiv 1306.0940.

While exploring, options whose learner has made no update come first, in random order: their values are unknown.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector, is_greedy
from hpamdp.policies.masks import masked_values, random_choice
from hpamdp.settings import Fraction
from hpamdp.specs import PAMDPSpecs


class Value(Selector):
    """Choose the option whose learner expects most; exploring, a random one with probability `epsilon`.

    Args:
        specs: sizes of the problem.
        epsilon: probability of a random option.
    """

    asks_learners = True

    def __init__(self, specs: PAMDPSpecs, *, epsilon: Fraction) -> None:
        super().__init__(specs)
        if specs.has_action_mask:
            self.in_keys.append(keys.ACTION_MASK)
        self.epsilon = epsilon

    def select(self, td: TensorDictBase) -> Tensor:
        """Return an option for every environment, int64 `[*B]`; 0 where no decision is due or the episode has ended."""
        is_decision = td.get(keys.IS_DECISION).squeeze(-1)
        done = td.get(keys.DONE, None)
        if done is not None:  # evaluations step on with episodes that have ended, and plans take long
            is_decision = is_decision & ~done.squeeze(-1)
        option = torch.zeros_like(is_decision, dtype=torch.long)
        if not is_decision.any():
            return option
        action_mask, option_mask = (
            None if mask is None else mask[is_decision]
            for mask in (td.get(keys.ACTION_MASK, None), td.get(keys.OPTION_MASK, None))
        )
        value = self.option_values(td.get(keys.OBSERVATION)[is_decision], action_mask)
        value = masked_values(value, option_mask)
        if is_greedy():
            best = value.argmax(-1)
        else:
            is_best = value == value.amax(-1, keepdim=True)
            best = torch.where(is_best, torch.rand_like(value), -1.0).argmax(-1)  # a random one of equals
            is_random = torch.rand(best.shape, device=best.device, dtype=torch.float32) < self.epsilon
            anything = random_choice(best.shape, self.specs.num_options, option_mask, best.device)
            best = torch.where(is_random, anything, best)
        option[is_decision] = best
        return option
