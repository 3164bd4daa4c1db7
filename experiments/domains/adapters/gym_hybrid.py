"""Moving and Sliding."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from published_rules import gym_hybrid
from torch import Tensor

from adapters import DirectAdapter, chosen
from hpamdp.env.gym_hybrid import rules
from hpamdp.env.gym_hybrid.options import PUBLISHED_STEPS

DOMAINS = ("moving", "sliding")


class DomainAdapter(DirectAdapter):
    """Moving and Sliding by their rules. Parameters are clipped as in the reference code."""

    outcomes = ("", "stopped at the target", "left the field", "limit")
    angles = ("heading", "course")
    state_type = rules.VehicleState

    def __init__(self, recording: dict[str, Any]) -> None:
        super().__init__(recording)
        self.slides = recording["domain"] == "sliding"
        self.recorded_names = {
            **{name: name for name in ("x", "y", "speed", "target_x", "target_y")},
            "heading": "theta",
            "course": "phi" if self.slides else "theta",
            "steps": "time",
        }

    def act(
        self, state: rules.VehicleState, steps: Sequence[dict[str, Any]]
    ) -> tuple[rules.VehicleState, dict[str, Tensor]]:
        discrete, parameters = chosen(steps, state.x)
        parameter = parameters.squeeze(-1)
        low, high = (torch.tensor([*side, 0.0]).to(parameter) for side in (rules.PARAMETER_LOW, rules.PARAMETER_HIGH))
        parameter = parameter.clamp(low[discrete], high[discrete])
        after, reward = gym_hybrid.act(state, discrete, parameter, slides=self.slides, max_steps=PUBLISHED_STEPS)
        return after, {"reward": reward}

    def observe(self, state: rules.VehicleState) -> Tensor:
        return gym_hybrid.observe(state, PUBLISHED_STEPS)
