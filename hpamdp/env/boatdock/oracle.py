"""The oracle of an environment: the planner's best controller, and its next press with each controller."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from hpamdp.env.boatdock import harbour, physics, planner
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.task import BoatState
from hpamdp.env.planning_oracle import PlanningOracle


class BoatDockOracle(PlanningOracle):
    """Keep the best plan of every option, made at the start of an episode, or when a boat is put somewhere.

    With noise or a `switch_cost`, the plans are made again before every press. There is one plan for each controller
    that the agent may choose.

    Args:
        num_envs: number of environments.
        rules: rules of the environment.
        device: device of the tensors.
    """

    saved_names = ("keys", "durations")

    def __init__(self, num_envs: int, rules: BoatDockOptions, device: torch.device) -> None:
        num_controllers = len(rules.names)
        shape = (num_envs, num_controllers if rules.controller == "choose" else 1, planner.MAX_PRESSES)
        super().__init__(shape, harbour.NUM_KEYS, (0.0, physics.MAX_DURATION), num_controllers, device)
        self.rules = rules

    def plan(self, state: BoatState, rows: Tensor) -> None:
        """Plan for the environments of `rows`, bool `[N]`, from their current positions."""
        boats = BoatState(*(column[rows] for column in state))
        plans = planner.plans_of_options(self.rules, boats)
        self.option[rows] = planner.better_option(plans)
        self.discrete[rows] = plans.keys
        self.parameters[rows] = plans.durations
        self.planned_at[rows] = boats.presses.long()

    def read(self, state: BoatState) -> TensorDict:
        """Return the best controller and the next press of each plan."""
        # Plan again if noise may have moved the boat, or if a change of controllers takes fuel, which alters the other
        # controllers' plans.
        if max(self.rules.noises) > 0.0 or self.rules.slip > 0.0 or self.rules.switch_cost is not None:
            self.plan(state, (state.presses > 0) & (state.outcome == physics.SAILING))
        return super().read(state)
