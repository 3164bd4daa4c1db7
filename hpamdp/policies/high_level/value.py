"""The option with the highest value by its learner's own estimate. The selector itself learns nothing.

A learner's critic, or its plan in a learned model, predicts the value of a state under each option before any option
was chosen there. Bandits need thousands of decisions to learn as much. If the learners remember the episode, so do
their values.

Source: the greedy policy over option values of Sutton, Precup and Singh 1999, *Between MDPs and semi-MDPs*, Artificial
Intelligence 112. While exploring, the value of PETS without `end_values` is that of a random member of its ensemble.
That makes the choice posterior sampling over options: Osband, Russo and Van Roy 2013, arXiv 1306.0940.

Differs from the sources:
- while exploring, some options are random (`epsilon`), and options whose learner has made no update come first, in
  random order;
- the member is drawn again at each decision. It need not be the one whose plans PETS then follows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.policies.base import Selector, States
from hpamdp.policies.high_level.options import CARDS, ValueOptions
from hpamdp.policies.masks import allowed_or_first, masked_values, random_choice
from hpamdp.specs import PAMDPSpecs

# Which options the session has tried before a decision, bool `[*B, num_options]`.
SESSION_TRIED = "session_tried"


class Value(Selector):
    """Choose the option with the highest value; while exploring, some options are random.

    With `untried_first`, the options that a session has tried travel in the tensordict, as the choice does.
    """

    Options = ValueOptions
    card = CARDS["Value"]
    learners_memory_key: str | None = None

    def __init__(self, specs: PAMDPSpecs, options: ValueOptions | None = None, **settings: Any) -> None:
        super().__init__(specs)
        self.options: ValueOptions = ValueOptions.of(options, settings)
        if specs.has_action_mask:
            self.in_keys.append(keys.ACTION_MASK)
        if self.options.untried_first:
            self.memory_key = SESSION_TRIED
            self.in_keys += [keys.EPISODE_STEPS, SESSION_TRIED]
            self.out_keys.append(SESSION_TRIED)
            self.export_refusal = f"remembers {SESSION_TRIED}"

    def take_option_values(self, option_values: nn.Module) -> None:
        """Compare these values; if they depend on what the learners remember, read that as well."""
        super().take_option_values(option_values)
        self.learners_memory_key = cast("str | None", option_values.memory_key)
        if self.learners_memory_key is not None:
            self.in_keys += [key for key in (keys.EPISODE_STEPS, self.learners_memory_key) if key not in self.in_keys]
            self.export_refusal = f"compares values that depend on {self.learners_memory_key}"

    @property
    def remembered_keys(self) -> list[str]:
        """The key of what the session has tried, and that of what the learners remember."""
        of_learners = [] if self.learners_memory_key is None else [self.learners_memory_key]
        return super().remembered_keys + of_learners

    def held_with(self, td: TensorDictBase, option: Tensor) -> dict[str, Tensor]:
        """Return, with `untried_first`, what the session has tried before the options."""
        return {SESSION_TRIED: self._tried(td)} if self.options.untried_first else {}

    def _tried(self, td: TensorDictBase) -> Tensor:
        """Return which options the session has tried before a decision, the last option included."""
        before, option = td.get(SESSION_TRIED, None), td.get(keys.OPTION, None)
        if before is None or option is None:
            shape = *td.batch_size, self.specs.num_options
            return torch.zeros(shape, dtype=torch.bool, device=td.get(keys.OBSERVATION).device)
        goes_on = td.get(keys.EPISODE_STEPS) > 0
        return goes_on & (before | F.one_hot(option, self.specs.num_options).bool())

    def select(self, td: TensorDictBase) -> Tensor:
        """Return an option for every environment, int64 `[*B]`.

        If no decision is due or the episode has ended, it is the first possible option.
        """
        if not self.options.untried_first:
            return self._best(td, torch.ones_like(td.get(keys.IS_DECISION).squeeze(-1)))
        tried = self._tried(td)
        is_open = ~tried if (mask := td.get(keys.OPTION_MASK, None)) is None else mask & ~tried
        return torch.where(is_open.any(-1), is_open.long().argmax(-1), self._best(td, ~is_open.any(-1)))

    def _best(self, td: TensorDictBase, is_asked: Tensor) -> Tensor:
        """Return what `select` does where `is_asked`, bool `[*B]`, and the first possible option elsewhere."""
        is_decision = is_asked & td.get(keys.IS_DECISION).squeeze(-1)
        done = td.get(keys.DONE, None)
        if done is not None:  # evaluations also step episodes that have ended, and planning for them takes time
            is_decision = is_decision & ~done.squeeze(-1)
        action_mask, option_mask = td.get(keys.ACTION_MASK, None), td.get(keys.OPTION_MASK, None)
        option = torch.zeros_like(is_decision, dtype=torch.long)
        if option_mask is not None:
            option = allowed_or_first(option, option_mask)
        if not is_decision.any():
            return option
        states = States(td.get(keys.OBSERVATION), action_mask, self._learners_memory(td), self.learners_memory_key)
        option_mask = None if option_mask is None else option_mask[is_decision]
        value = masked_values(self.option_values(states.at(is_decision)), option_mask)
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

        def greedy(td: TensorDictBase) -> Tensor:
            states = States(td.get(keys.OBSERVATION), td.get(keys.ACTION_MASK, None))
            return masked_values(self.option_values(states), td.get(keys.OPTION_MASK, None)).argmax(-1)

        return greedy

    def _learners_memory(self, td: TensorDictBase) -> Tensor | None:
        """Return what the learners remember of the episode's steps before, `[*B, size]`; None if nothing."""
        memory = None if self.learners_memory_key is None else td.get(self.learners_memory_key, None)
        return None if memory is None else torch.where(td.get(keys.EPISODE_STEPS) > 0, memory, 0.0)
