"""An action of several components as one choice among all combinations, for planners that search sequences."""

from __future__ import annotations

import math
from itertools import product

import torch
from torch import Tensor, nn

from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

_MAX_CHOICES = 65_536


class JointChoice(nn.Module):
    """The combinations of the components' choices, numbered from 0. With one component, they are its discrete actions.

    Args:
        specs: of the problem.

    Attributes:
        num: number of combinations, J.
        parameter_dims: number of parameters of each combination, J entries, at most D.
        slots: places of a combination's own parameters among all parameters, int64 `[J, D]`. If it has fewer than D,
            places of other parameters follow.
        has_slot: 1 where `slots` is the place of an own parameter, else 0; float32 `[J, D]`.
        choices: what each combination chooses, int64 `[J, num_components]`; only with several components.
        strides: `choices @ strides` are the numbers, int64 `[num_components]`; only with several components.
        is_chosen: which discrete actions each combination has, bool `[J, num_discrete]`; only with several components.

    Raises:
        SettingError: there are more than 65,536 combinations.
    """

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        self.components = specs.components
        self.num_parameters = specs.num_parameters
        sizes = self.components.sizes
        self.num = math.prod(sizes)
        if self.components.is_single:
            self.parameter_dims = specs.parameter_dims
            own = torch.arange(max(specs.parameter_dims)) < torch.tensor(specs.parameter_dims).unsqueeze(-1)
            slots, has_slot = specs.parameter_slots, own
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
            # The stable sort puts the places of own parameters first, in their order.
            own_first = (~is_own).to(torch.int8).argsort(dim=-1, stable=True)
            slots = own_first[:, : max(self.parameter_dims)]
            has_slot = is_own.gather(-1, slots)
            strides = torch.tensor([math.prod(sizes[place + 1 :]) for place in range(len(sizes))])
            self.choices = nn.Buffer(choices, persistent=False)
            self.strides = nn.Buffer(strides, persistent=False)
            self.is_chosen = nn.Buffer(is_chosen, persistent=False)
        self.slots = nn.Buffer(slots, persistent=False)
        self.has_slot = nn.Buffer(has_slot.float(), persistent=False)

    def number(self, choice: Tensor) -> Tensor:
        """Return the numbers of the combinations, `[*B]`, given choices `[*B]` or `[*B, num_components]`."""
        return choice if self.components.is_single else (choice * self.strides).sum(-1)

    def choice(self, number: Tensor) -> Tensor:
        """Return the choices, given numbers `[*B]` of combinations; the inverse of `number`."""
        return number if self.components.is_single else self.choices[number]

    def allowed(self, mask: Tensor) -> Tensor:
        """Return which combinations are allowed, bool `[*B, J]`, given a mask bool `[*B, num_discrete]`."""
        if self.components.is_single:
            return mask
        return ~(self.is_chosen & ~mask.unsqueeze(-2)).any(-1)

    def spread(self, number: Tensor, own: Tensor) -> Tensor:
        """Return parameters `[*B, num_parameters]`: those of a combination in their places, and 0 for all others.

        Args:
            number: of the combination, `[*B]`.
            own: its own parameters, `[*B, D]`.
        """
        parameters = own.new_zeros(*own.shape[:-1], self.num_parameters)
        return parameters.scatter(-1, self.slots[number], own * self.has_slot[number])

    def own(self, number: Tensor, parameters: Tensor) -> Tensor:
        """Return a combination's own parameters `[*B, D]`; the inverse of `spread`.

        Args:
            number: of the combination, `[*B]`.
            parameters: all parameters, `[*B, num_parameters]`.
        """
        return parameters.gather(-1, self.slots[number]) * self.has_slot[number]
