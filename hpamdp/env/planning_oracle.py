"""What knows the best actions of a batch of environments, by plans that it makes when episodes begin."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, TensorSpec


class PlanningOracle(ABC):
    """Keep plans for N environments, one for each option, and tell their next actions.

    A problem whose best actions follow from the state alone defines `BatchedEnv.scripted_action` instead.

    Args:
        shape: numbers N of environments, P of plans for each and L of actions in a plan.
        num_discrete: number of discrete actions.
        bounds: of the parameter, the same for all discrete actions.
        num_options: number of options; if 0, `read` has no `option`.
        device: of the tensors.

    Attributes:
        discrete, parameters: the plans, `[N, P, L]`.
        option: the best option, int64 `[N]`.
        planned_at: steps of the episode before the plan, int64 `[N]`; 0 where a subclass shifts the plan itself.
    """

    saved_names: ClassVar[tuple[str, str]]  # of `discrete` and `parameters` in a checkpoint

    def __init__(
        self,
        shape: tuple[int, int, int],
        num_discrete: int,
        bounds: tuple[float, float],
        num_options: int,
        device: torch.device | None,
    ) -> None:
        self.discrete = torch.zeros(shape, dtype=torch.long, device=device)
        self.parameters = torch.zeros(shape, dtype=torch.float32, device=device)
        self.option = torch.zeros(shape[0], dtype=torch.long, device=device)
        self.planned_at = torch.zeros_like(self.option)
        self._entries: dict[str, TensorSpec] = {
            "discrete": Categorical(num_discrete, shape=shape[:2], device=device),
            "parameters": Bounded(*bounds, shape=shape[:2], device=device, dtype=torch.float32),
        }
        if num_options:
            self._entries["option"] = Categorical(num_options, shape=shape[:1], device=device)

    def spec(self) -> Composite:
        """Return the spec of the entries that `read` returns."""
        return Composite(self._entries, shape=self.option.shape)

    @abstractmethod
    def plan(self, state: Any, rows: Tensor) -> None:
        """Plan for the environments of `rows`, bool `[N]`, from their states."""

    def read(self, state: Any) -> TensorDict:
        """Return the next action of each plan, `discrete` and `parameters` `[N, P]`, and the best `option` `[N]`.

        After the end of a plan its last discrete action goes on, with the parameter 0.
        """
        number, length = state.steps.long() - self.planned_at, self.discrete.shape[-1]
        place = number.clamp(max=length - 1).view(-1, 1, 1).expand(-1, self.discrete.shape[1], 1)
        discrete, parameters = (each.gather(-1, place).squeeze(-1) for each in (self.discrete, self.parameters))
        known = {"discrete": discrete, "parameters": parameters.where((number < length).unsqueeze(-1), 0.0)}
        if "option" in self._entries:
            known["option"] = self.option.clone()
        return TensorDict(known, batch_size=number.shape, device=number.device)

    def plans(self) -> dict[str, Tensor]:
        """Return the plans for a checkpoint, first dimension `N`."""
        plans = dict(zip(self.saved_names, (self.discrete, self.parameters), strict=True))
        return {"option": self.option, "planned_at": self.planned_at, **plans}

    def set_plans(self, plans: Mapping[str, Tensor]) -> None:
        """Restore the result of `plans`. What it lacks is 0."""
        for name, own in self.plans().items():
            own.copy_(plans.get(name, torch.zeros_like(own)))
