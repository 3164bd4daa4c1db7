"""An action of several components as one choice, for planners that try sequences of choices."""

from __future__ import annotations

import math
from itertools import product

import torch
from torch import Tensor, nn

from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

_MAX_CHOICES = 65_536


class JointChoice(nn.Module):
    """All ways to choose in every component, numbered; with one component the numbers are its discrete actions.

    Args:
        specs: of the problem.

    Attributes:
        num: how many there are, J.
        parameter_dims: number of parameters of each, J entries.
        slots: the indices of their own parameters among all, int64 `[J, D]`; indices of others fill the rest.
        has_slot: which of these are their own, float32 `[J, D]`.
        is_chosen: which discrete actions each takes, bool `[J, num_discrete]`; only with several components.

    Raises:
        SettingError: there are too many for the tables.
    """

    choices: Tensor
    strides: Tensor
    slots: Tensor
    has_slot: Tensor
    is_chosen: Tensor

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.components = specs.components
        self.num_parameters = specs.num_parameters
        sizes = self.components.sizes
        self.num = math.prod(sizes)
        if self.components.is_single:
            self.parameter_dims = specs.parameter_dims
            own = torch.arange(max(specs.parameter_dims)) < torch.tensor(specs.parameter_dims).unsqueeze(-1)
            tables = {"slots": specs.parameter_slots, "has_slot": own.float()}
        else:
            if self.num > _MAX_CHOICES:
                raise SettingError(
                    f"the action's {len(sizes)} components make {self.num:,} choices, but a sequence search takes at "
                    f"most {_MAX_CHOICES:,}; use low=dlpa or low=hppo"
                )
            choices = torch.tensor(list(product(*(range(size) for size in sizes))))
            is_chosen = self.components.is_chosen(choices)
            is_own = is_chosen.index_select(-1, specs.parameter_owner)
            self.parameter_dims = tuple(is_own.sum(-1).tolist())
            slots = (~is_own).to(torch.int8).argsort(dim=-1, stable=True)[:, : max(self.parameter_dims)]
            tables = {"slots": slots, "has_slot": is_own.gather(-1, slots).float(), "choices": choices}
            strides = [math.prod(sizes[place + 1 :]) for place in range(len(sizes))]
            tables |= {"strides": torch.tensor(strides), "is_chosen": is_chosen}
        for name, table in tables.items():
            self.register_buffer(name, table, persistent=False)

    def number(self, choice: Tensor) -> Tensor:
        """Return the numbers `[*B]` of choices `[*B]` or `[*B, num_components]`."""
        return choice if self.components.is_single else (choice * self.strides).sum(-1)

    def choice(self, number: Tensor) -> Tensor:
        """Return the choices of numbers `[*B]`, the inverse of `number`."""
        return number if self.components.is_single else self.choices[number]

    def allowed(self, mask: Tensor) -> Tensor:
        """Return which numbers a mask bool `[*B, num_discrete]` allows, bool `[*B, J]`."""
        if self.components.is_single:
            return mask
        return ~(self.is_chosen & ~mask.unsqueeze(-2)).any(-1)

    def spread(self, number: Tensor, own: Tensor) -> Tensor:
        """Return parameters `[*B, num_parameters]`, 0 but for the own ones `[*B, D]` of numbered choices `[*B]`."""
        everything = own.new_zeros(*own.shape[:-1], self.num_parameters)
        return everything.scatter(-1, self.slots[number], own * self.has_slot[number])

    def own(self, number: Tensor, everything: Tensor) -> Tensor:
        """Return the own parameters `[*B, D]` of numbered choices, of all parameters `[*B, num_parameters]`."""
        return everything.gather(-1, self.slots[number]) * self.has_slot[number]
