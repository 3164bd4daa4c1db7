"""Platform, with the recorded random numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from adapters import chosen, limited
from hpamdp.env.platform import rules

DOMAINS = ("platform",)
_SECOND_PLATFORM = 475.0  # beyond it, the second enemy is the active one


class DomainAdapter:
    """Platform by its rules.

    Our state has only the active enemy, since the other stands still. It has no heights, since after an action the
    agent stands or the episode is over. The rules do not return the number of ticks of an action.
    """

    outcomes = ("", "arrived", "fell", "enemy", "limit")
    angles = ()
    float32_tolerance = 1e-3

    def __init__(self, recording: dict[str, Any]) -> None:
        self.state_names: list[str] = recording["state_names"]

    def columns(self, rows: Sequence[Sequence[float]]) -> dict[str, Tensor]:
        """Return the columns of our state, float64 `[N]`."""
        table = torch.tensor(rows, dtype=torch.float64)
        recorded = dict(zip(self.state_names, table.unbind(-1), strict=True))
        is_second = recorded["x"] > _SECOND_PLATFORM
        return {
            "x": recorded["x"],
            "speed": recorded["vx"],
            "enemy_x": torch.where(is_second, recorded["enemy2_x"], recorded["enemy1_x"]),
            "enemy_speed": torch.where(is_second, recorded["enemy2_dx"], recorded["enemy1_dx"]),
        }

    def states(self, rows: Sequence[Sequence[float]], taken: Sequence[int], dtype: torch.dtype) -> rules.PlatformState:
        columns = self.columns(rows).values()
        none = torch.zeros(len(rows), dtype=torch.int32)
        steps = torch.tensor(taken, dtype=torch.int32)
        return rules.PlatformState(*(column.to(dtype) for column in columns), steps, none, none)

    def named(self, state: rules.PlatformState) -> dict[str, Tensor]:
        return {name: getattr(state, name) for name in ("x", "speed", "enemy_x", "enemy_speed")}

    def act(
        self, state: rules.PlatformState, steps: Sequence[dict[str, Any]]
    ) -> tuple[rules.PlatformState, dict[str, Tensor]]:
        discrete, parameters = chosen(steps, state.x)
        parameter = (
            parameters.squeeze(-1).clamp(min=0.0).minimum(torch.tensor(rules.PARAMETER_HIGH).to(state.x)[discrete])
        )
        drawn = [[*(step["jump"] or (0.0, 0.0)), *(z for row in step["draws"] for z in row)] for step in steps]
        longest = max(len(row) for row in drawn)
        numbers = torch.tensor([row + [0.0] * (longest - len(row)) for row in drawn], dtype=torch.float64).to(state.x)

        def normal(index: Tensor) -> Tensor:
            # Our rules simulate all actions for as many ticks as the longest one.
            place = (index - first).long().expand(*index.shape[:-1], len(steps))
            is_drawn = place < longest
            found = numbers.expand(*place.shape[:-1], *numbers.shape) if place.dim() > 1 else numbers
            return found.gather(-1, place.clamp(max=longest - 1).unsqueeze(-1)).squeeze(-1) * is_drawn

        first = rules.first_number(state)
        after = rules.act(state, discrete, parameter, normal, 1.0)
        return limited(after, 200, rules.TIME_LIMIT), {"reward": (after.x - state.x) / rules.END}

    def observe(self, state: rules.PlatformState) -> Tensor:
        """Return the observations in [0, 1], as in gym-platform."""
        return (rules.observe(state) + 1.0) / 2.0
