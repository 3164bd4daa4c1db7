"""Goal and Hard Goal, with the recorded random numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from published_rules import goal
from torch import Tensor

from adapters import DirectAdapter, chosen
from hpamdp.env.goal import rules

DOMAINS = ("goal", "hard_goal")
_SPARE_TICKS = 16  # our rules check only every few ticks whether all actions are over


class DomainAdapter(DirectAdapter):
    """Goal and Hard Goal by their rules. Hard Goal's actions become Goal's, as in the environment."""

    outcomes = ("", "goal", "caught", "out", "limit")
    angles = ("player_angle", "keeper_angle")
    float32_tolerance = 2e-4
    state_type = rules.GoalState
    recorded_names = {name: name for name in rules.COLUMNS} | {"steps": "time"}

    def __init__(self, recording: dict[str, Any]) -> None:
        super().__init__(recording)
        self._aim = goal.hard_goal_aim if recording["domain"] == "hard_goal" else goal.goal_aim

    def act(self, state: rules.GoalState, steps: Sequence[dict[str, Any]]) -> tuple[rules.GoalState, dict[str, Tensor]]:
        discrete, parameters = chosen(steps, state.ball_x, 2)
        longest = max(len(step["draws"]) for step in steps) + _SPARE_TICKS
        drawn = state.ball_x.new_zeros(longest, rules.NUMBERS_PER_TICK, len(steps))
        for row, step in enumerate(steps):
            for tick, values in enumerate(step["draws"]):
                drawn[tick, :, row] = torch.tensor(values, dtype=torch.float64).to(drawn)

        def numbers(ticks: Tensor, rows: Tensor) -> Tensor:
            return drawn[ticks.long()][:, :, rows]

        moves = torch.ones(len(steps), dtype=torch.bool)
        after, ticks = goal.act(state, self._aim(discrete, parameters), moves, numbers)
        return after, {"reward": goal.reward(state, after), "ticks": ticks}

    def observe(self, state: rules.GoalState) -> Tensor:
        """Return the observations as they are recorded, not scaled."""
        return goal.observe(state, is_scaled=False)
