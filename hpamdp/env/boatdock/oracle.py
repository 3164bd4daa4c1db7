"""The oracle of an environment: the planner's best controller, and its next press with each controller."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite

from hpamdp.env.boatdock import harbour, physics, planner
from hpamdp.env.boatdock.task import BoatState, Rules


def _num_plans(rules: Rules) -> int:
    """Return the number of plans per environment: one for each controller that the agent may choose."""
    return len(rules.names) if rules.controller == "choose" else 1


class BoatDockOracle:
    """Keep the best plan of every option, made at the start of an episode, or when a boat is put somewhere.

    With noise or a `switch_cost`, the plans are made again before every press.

    Args:
        num_envs: number of environments.
        rules: rules of the environment.
        device: device of the tensors.

    Attributes:
        option: the best controller, int64 `[N]`.
        keys, durations: keys and durations of the planned presses, `[N, num_plans, MAX_PRESSES]`.
        planned_at: presses before the plan, int64 `[N]`; above 0 if a boat was put somewhere within an episode.
    """

    def __init__(self, num_envs: int, rules: Rules, device: torch.device) -> None:
        self.rules = rules
        self.option = torch.zeros(num_envs, dtype=torch.long, device=device)
        shape = (num_envs, _num_plans(rules), planner.MAX_PRESSES)
        self.keys = torch.zeros(shape, dtype=torch.long, device=device)
        self.durations = torch.zeros(shape, device=device, dtype=torch.float32)
        self.planned_at = torch.zeros(num_envs, dtype=torch.long, device=device)

    def spec(self) -> Composite:
        """Return the spec of the entries that `read` returns."""
        shape, device = self.keys.shape[:2], self.option.device
        return Composite(
            option=Categorical(len(self.rules.names), shape=shape[:1], device=device),
            discrete=Categorical(harbour.NUM_KEYS, shape=shape, device=device),
            parameters=Bounded(0.0, physics.MAX_DURATION, shape=shape, device=device, dtype=torch.float32),
            shape=shape[:1],
        )

    def plans(self) -> dict[str, Tensor]:
        """Return the plans for a checkpoint, with `planned_at` if a boat was put in the middle of an episode."""
        plans = {"option": self.option, "keys": self.keys, "durations": self.durations}
        return plans | ({"planned_at": self.planned_at} if self.planned_at.any() else {})

    def set_plans(self, plans: Mapping[str, Tensor]) -> None:
        """Restore the result of `plans`."""
        self.planned_at.zero_()
        for name, plan in plans.items():
            getattr(self, name).copy_(plan)

    def plan(self, state: BoatState, rows: Tensor) -> None:
        """Plan for the environments of `rows`, bool `[N]`, from their current positions."""
        boats = BoatState(*(column[rows] for column in state))
        plans = planner.plans_of_options(self.rules, boats)
        self.option[rows] = planner.better_option(plans)
        self.keys[rows] = plans.keys
        self.durations[rows] = plans.durations
        self.planned_at[rows] = boats.presses.long()

    def read(self, state: BoatState) -> TensorDict:
        """Return `option` `[N]` and the next press of each plan, `discrete` and `parameters` `[N, num_plans]`."""
        # Plan again if noise may have moved the boat, or if a change of controllers takes fuel, which alters the other
        # controllers' plans.
        if max(self.rules.motor_noise) > 0.0 or self.rules.slip > 0.0 or self.rules.switch_cost is not None:
            self.plan(state, (state.presses > 0) & (state.outcome == physics.SAILING))
        num_presses = state.presses.long() - self.planned_at
        index = num_presses.clamp(max=planner.MAX_PRESSES - 1).view(-1, 1, 1).expand(-1, self.keys.shape[1], 1)
        keys = self.keys.gather(-1, index).squeeze(-1)
        durations = self.durations.gather(-1, index).squeeze(-1)
        # After the end of a plan the duration is 0.
        is_planned = (num_presses < planner.MAX_PRESSES).unsqueeze(-1)
        return TensorDict(
            {
                "option": self.option.clone(),
                "discrete": keys,
                "parameters": torch.where(is_planned, durations, 0.0),
            },
            batch_size=num_presses.shape,
            device=num_presses.device,
        )
