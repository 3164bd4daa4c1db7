"""Actions of several components: which logits, values and mask entries belong to which component.

A component is one discrete choice, or a box. A box is a choice with one discrete action, which owns the box's
parameters. The discrete actions of all components lie side by side in logits, values and masks. A choice is numbered
from 0 within its component.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate, combinations

import torch
from torch import Tensor

# A `pair_mask` is checked against every combination, so there may be at most this many.
MAX_PAIRED = 65_536


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

    def may_follow(self, choice: Tensor, pair_mask: Tensor) -> Tensor:
        """Return whether each component's choice may follow those of earlier components, bool `[*B, num_components]`.

        Args:
            choice: int64 `[*B, num_components]`.
            pair_mask: whether the column's action may follow the row's, bool `[*B, num_discrete, num_discrete]`.
        """
        places = self.places(choice)
        num = places.shape[-1]
        pairs = pair_mask.gather(-2, places.unsqueeze(-1).expand(*places.shape, pair_mask.shape[-1]))
        pairs = pairs.gather(-1, places.unsqueeze(-2).expand(*places.shape, num))
        return (pairs | pairs.new_ones(num, num).tril()).all(-2)

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

        With a `pair_mask` it may choose what the later components can complete. So no sequence of such choices ends
        where nothing is left.

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
        # All ways to choose in this and the later components, as places among all discrete actions, `[J, components]`.
        ranges = [torch.arange(size, device=allowed.device) for size in self.sizes[number:]]
        starts = torch.tensor(self.starts[number:], device=allowed.device)
        places = torch.cartesian_prod(*ranges).reshape(-1, len(ranges)) + starts
        is_possible = allowed[..., places].all(-1)
        for earlier, later in combinations(places.unbind(-1), 2):
            is_possible = is_possible & pair_mask[..., earlier, later]
        return is_possible.unflatten(-1, (size, -1)).any(-1)

    def leaves_any(self, mask: Tensor, pair_mask: Tensor | None = None) -> Tensor:
        """Return whether any choice is allowed, bool `[*B]`; arguments as for `allowed_next`."""
        if pair_mask is None:
            return self.any_of_each(mask)
        first = self.allowed_next(0, torch.zeros_like(mask), mask, pair_mask)
        assert first is not None
        return first.any(-1)
