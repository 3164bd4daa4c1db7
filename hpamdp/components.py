"""Actions of several components: which logits, values and mask entries belong to which component.

A component is one discrete choice, or a box. A box is a choice with one discrete action, which owns the box's
parameters. The discrete actions of all components lie side by side in logits, values and masks. A choice is numbered
from 0 within its component.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate

import torch
from torch import Tensor


@dataclass(frozen=True)
class Components:
    """The components of an action.

    With one component, choices have the shape `[*B]`, with several `[*B, num_components]`.

    Attributes:
        sizes: number of discrete actions of each component.
    """

    sizes: tuple[int, ...]

    @property
    def is_single(self) -> bool:
        """Whether there is one component."""
        return len(self.sizes) == 1

    @property
    def starts(self) -> tuple[int, ...]:
        """Place of each component's first discrete action."""
        return (0, *accumulate(self.sizes[:-1]))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of one choice: empty, or the number of components."""
        return () if self.is_single else (len(self.sizes),)

    def component_of(self, device: torch.device | None = None) -> Tensor:
        """Return int64 `[num_discrete]`: the component of each discrete action."""
        numbers = torch.arange(len(self.sizes), device=device)
        return numbers.repeat_interleave(torch.tensor(self.sizes, device=device), output_size=sum(self.sizes))

    def best(self, values: Tensor) -> Tensor:
        """Return the choice with the largest values `[*B, num_discrete]`."""
        if self.is_single:
            return values.argmax(-1)
        return torch.stack([part.argmax(-1) for part in values.split(self.sizes, -1)], -1)

    def places(self, choice: Tensor) -> Tensor:
        """Return the places of the chosen discrete actions among all, int64 `[*B, num_components]`."""
        if self.is_single:
            return choice.unsqueeze(-1)
        return choice + torch.tensor(self.starts, device=choice.device)

    def exists(self, choice: Tensor) -> Tensor:
        """Return whether the discrete action chosen in each component exists, bool `[*B]`."""
        if self.is_single:
            return (choice >= 0) & (choice < self.sizes[0])
        return ((choice >= 0) & (choice < torch.tensor(self.sizes, device=choice.device))).all(-1)

    def of_choice(self, values: Tensor, choice: Tensor) -> Tensor:
        """Return the values of the chosen discrete actions, given the values of all, `[*B, num_discrete]`."""
        entries = values.gather(-1, self.places(choice))
        return entries.squeeze(-1) if self.is_single else entries

    def is_chosen(self, choice: Tensor) -> Tensor:
        """Return which discrete actions are chosen, bool `[*B, num_discrete]`."""
        if self.is_single:
            return torch.arange(self.sizes[0], device=choice.device) == choice.unsqueeze(-1)
        numbers = torch.cat([torch.arange(size) for size in self.sizes]).to(choice.device)
        return numbers == choice.index_select(-1, self.component_of(choice.device))

    def log_softmax(self, logits: Tensor) -> Tensor:
        """Return log-probabilities `[*B, num_discrete]`, normalised within each component, of logits of this shape."""
        if self.is_single:
            return logits.log_softmax(-1)
        return torch.cat([part.log_softmax(-1) for part in logits.split(self.sizes, -1)], -1)

    def any_of_each(self, mask: Tensor) -> Tensor:
        """Return whether a mask bool `[*B, num_discrete]` allows a discrete action of each component, bool `[*B]`."""
        if self.is_single:
            return mask.any(-1)
        return torch.stack([part.any(-1) for part in mask.split(self.sizes, -1)], -1).all(-1)

    def total(self, values: Tensor) -> Tensor:
        """Return the sum over the components, `[*B]`, of one value for each: `[*B]` or `[*B, num_components]`."""
        return values if self.is_single else values.sum(-1)

    def allowed_next(
        self, number: int, is_chosen: Tensor, mask: Tensor | None, pair_mask: Tensor | None
    ) -> Tensor | None:
        """Return which discrete actions a component may choose after those before it, bool `[*B, size]`; if None, all.

        A choice that would leave nothing to a later component is left out. With three or more components, two choices
        that leave something each may together leave nothing, so a `pair_mask` must allow a choice after each such pair.

        Args:
            number: of the component that chooses.
            is_chosen: what the components before it have chosen, bool `[*B, num_discrete]`.
            mask: the discrete actions that may be taken, bool `[*B, num_discrete]`; if None, all.
            pair_mask: whether the column's discrete action may follow the row's, bool
                `[*B, num_discrete, num_discrete]`; if None, all pairs.
        """
        begin, size = self.starts[number], self.sizes[number]
        if pair_mask is None:
            return None if mask is None else mask[..., begin : begin + size]
        allowed = (pair_mask | ~is_chosen.unsqueeze(-1)).all(-2)
        if mask is not None:
            allowed = allowed & mask
        own = allowed[..., begin : begin + size]
        follows = pair_mask[..., begin : begin + size, :] & allowed.unsqueeze(-2)
        for start, later in zip(self.starts[number + 1 :], self.sizes[number + 1 :], strict=True):
            own = own & follows[..., start : start + later].any(-1)
        return own
