"""Hard Move with any number of actuators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from published_rules import hard_move, points
from torch import Tensor

from adapters import DirectAdapter, chosen, limited
from hpamdp.env.hard_move import rules

DOMAINS = tuple(f"hard_move_{n}" for n in (4, 6, 8, 10))


class DomainAdapter(DirectAdapter):
    """Hard Move by its rules, which clip no parameter, with our own table of motions."""

    outcomes = ("", "reached", "limit")
    state_type = rules.HardMoveState
    recorded_names = {  # noqa: RUF012
        **{name: name for name in ("x", "y", "vx", "vy", "target_x", "target_y")},
        "steps": "time",
    }

    def __init__(self, recording: dict[str, Any]) -> None:
        super().__init__(recording)
        self.motions = rules.motions(recording["num_actuators"], rounded=True)
        recorded = torch.tensor(recording["motions"], dtype=torch.float64)
        if recorded.shape != self.motions.shape or not torch.allclose(self.motions, recorded, rtol=0.0, atol=1e-12):
            raise ValueError("the recorded motions are not those of our rules")

    def act(
        self, state: rules.HardMoveState, steps: Sequence[dict[str, Any]]
    ) -> tuple[rules.HardMoveState, dict[str, Tensor]]:
        discrete, parameters = chosen(steps, state.x)
        after, reward = hard_move.act(state, discrete, parameters.squeeze(-1), self.motions.to(state.x.dtype))
        return limited(after, 30, rules.TIME_LIMIT), {"reward": reward}

    def observe(self, state: rules.HardMoveState) -> Tensor:
        return points.observe(state)
