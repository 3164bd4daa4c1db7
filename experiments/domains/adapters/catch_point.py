"""Catch Point."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from published_rules import catch_point
from torch import Tensor

from adapters import DirectAdapter, chosen, limited
from hpamdp.env.catch_point import rules
from hpamdp.env.catch_point.options import PUBLISHED_CATCHES

DOMAINS = ("catch_point",)


class DomainAdapter(DirectAdapter):
    """Catch Point by its rules, which clip no parameter."""

    outcomes = ("", "caught", "no catches left", "limit")
    state_type = rules.CatchPointState
    recorded_names = {  # noqa: RUF012
        **{name: name for name in ("x", "y", "vx", "vy", "target_x", "target_y")},
        "misses": "missed_catches",
        "steps": "time",
    }

    def act(
        self, state: rules.CatchPointState, steps: Sequence[dict[str, Any]]
    ) -> tuple[rules.CatchPointState, dict[str, Tensor]]:
        discrete, parameters = chosen(steps, state.x)
        after, reward = catch_point.act(
            state, discrete, parameters.squeeze(-1), catches=PUBLISHED_CATCHES, late_end=True
        )
        return limited(after, 25, rules.TIME_LIMIT), {"reward": reward}

    def observe(self, state: rules.CatchPointState) -> Tensor:
        return catch_point.observe(state, progress=False)
