"""What the planner knows of the boats at hand: the better controller and each controller's next press."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite

from hpamdp.env.boatdock import harbour, physics, planner
from hpamdp.env.boatdock.episode import BoatState, Rules


def oracle_spec(num_envs: int, rules: Rules, device: torch.device) -> Composite:
    """Return the spec of what `BoatDockOracle.read` gives."""
    n, plans = num_envs, _num_plans(rules)
    return Composite(
        option=Categorical(len(harbour.CONTROLLERS), shape=(n,), device=device),
        discrete=Categorical(harbour.NUM_KEYS, shape=(n, plans), device=device),
        parameters=Bounded(0.0, physics.MAX_DURATION, shape=(n, plans), device=device),
        shape=(n,),
    )


def _num_plans(rules: Rules) -> int:
    return len(harbour.CONTROLLERS) if rules.controller == "choose" else 1


class BoatDockOracle:
    """Holds the best plan of every boat; plans at the start of an episode and, with noise, anew before every press."""

    def __init__(self, num_envs: int, rules: Rules, device: torch.device) -> None:
        self.rules = rules
        self.option = torch.zeros(num_envs, dtype=torch.long, device=device)
        shape = (num_envs, _num_plans(rules), planner.MAX_PRESSES)
        self.keys = torch.zeros(shape, dtype=torch.long, device=device)
        self.durations = torch.zeros(shape, device=device)

    def plan(self, state: BoatState, rows: Tensor) -> None:
        """Plan for the boats of `rows` bool `[N]` from where they are."""
        boats = BoatState(*(column[rows] for column in state))
        plans = [self._plan_with(boats, controller) for controller in range(_num_plans(self.rules))]
        stacked = planner.Plan(*(torch.stack(fields, 1) for fields in zip(*plans, strict=True)))
        self.option[rows] = planner.better_option(stacked)
        self.keys[rows], self.durations[rows] = stacked.keys, stacked.durations

    def _plan_with(self, boats: BoatState, controller: int) -> planner.Plan:
        if self.rules.controller == "choose":
            held = torch.full_like(boats.controller, controller)
        else:
            held = boats.controller
        return planner.best_plan(boats.x, boats.y, boats.goal_x, boats.goal_y, boats.fuel, held, boats.keymap)

    def read(self, state: BoatState) -> TensorDict:
        """Return `option` `[N]` and each option's next press, `discrete` and `parameters` `[N, num_options]`."""
        pressed = state.presses.long()
        if max(self.rules.motor_noise) > 0.0 or self.rules.slip > 0.0:
            self.plan(state, (state.presses > 0) & (state.outcome == physics.SAILING))
            pressed = torch.zeros_like(pressed)
        index = pressed.clamp(max=planner.MAX_PRESSES - 1).view(-1, 1, 1).expand(-1, self.keys.shape[1], 1)
        # Past the plan's end nothing is pressed: there is no plan that still docks.
        is_planned = (pressed < planner.MAX_PRESSES).unsqueeze(-1)
        return TensorDict(
            {
                "option": self.option.clone(),
                "discrete": self.keys.gather(-1, index).squeeze(-1),
                "parameters": torch.where(is_planned, self.durations.gather(-1, index).squeeze(-1), 0.0),
            },
            batch_size=pressed.shape,
            device=pressed.device,
        )
