"""Office as a batched TorchRL environment: fetch coffee and mail, then bring both to a target.

Source: the Office domain of PEARL, AAAI 2026, arXiv:2512.20831; see `hpamdp.env.office.rules`, also for the
differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torchrl.data import Binary, TensorSpec

from hpamdp import keys
from hpamdp.env.batched_env import KernelEnv
from hpamdp.env.office import kernel, player, rendering, rules
from hpamdp.env.office.options import CARDS, GOALS, OfficeOptions
from hpamdp.env.office.rules import OfficeState
from hpamdp.env.state_columns import check_range
from hpamdp.env.tiles import bounds_with_tiles, tile_names

# Expected return and success of the player that knows the map, with the default settings.
_PLAYER = {"score": 956.4, "success": 1.0}


class OfficeEnv(KernelEnv[OfficeState]):
    """Fetch coffee and mail and deliver both in `num_envs` offices at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 up, 1 down, 2 left, 3 right; `("action", "parameters")`
    float32 `[N, 4]`: the length of each move with its sign, in [-0.05, 0] for up and left, in [0, 0.05] for down and
    right; with `chooses_goal` also `option` int64 `[N]`: 0 coffee, 1 mail, 2 target. Only the parameter of the chosen
    action counts; outside its bounds it is clipped, NaN and infinity are refused.

    A move costs 1. A move that would touch a wall is refused, and costs 2. The step that takes coffee or mail costs
    nothing. The step that delivers has the reward 1000 instead, and terminates the episode.

    Only the slips are random. The player of `oracle` is `hpamdp.env.office.player`. For the constructor's arguments and
    errors see `BatchedEnv`.
    """

    Options = OfficeOptions
    card = CARDS["OfficeEnv"]
    options: OfficeOptions
    discrete_names = rules.ACTIONS
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    parameter_dims = (1, 1, 1, 1)
    parameter_low = rules.PARAMETER_LOW
    parameter_high = rules.PARAMETER_HIGH
    row_kernel = staticmethod(kernel.advance)
    state_type = OfficeState
    num_columns = (2, 5)

    def _prepare(self) -> None:
        self.observation_names = rules.OBSERVATION_NAMES + tile_names(self.options.tiles)

    def kernel_settings(self) -> Sequence[float]:
        """Return the probability of a slip and the number of tiles."""
        return [self.options.slip, self.options.tiles]

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]]:
        """The lowest and the highest observation, `[4 + 2 tiles]` each."""
        return bounds_with_tiles(len(rules.OBSERVATION_NAMES), self.options.tiles)

    def scripted_action(self, state: OfficeState) -> tuple[Tensor, Tensor]:
        """Return the move and the length of the player that knows the map, `[N, 1]` each, or `[N, 3]` with options."""
        return player.plan(state, self.options.slip, chooses_goal=self.options.chooses_goal)

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the figures of the player that knows the map, which are known for the default settings."""
        is_published = (self.max_steps, self.options.slip) == (400, 0.1)
        return {"scripted": _PLAYER} if is_published else {}

    def check_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Refuse counters and outcomes that do not exist, and more than one coffee or mail.

        Raises:
            ValueError: a number is invalid.
        """
        super().check_env_state(columns)
        check_range(columns, {"coffee": (0, 2), "mail": (0, 2)})

    def _knowledge_specs(self) -> dict[str, TensorSpec]:
        """Return the specs of the player's actions and of the open goals."""
        specs = super()._knowledge_specs()
        if self.options.chooses_goal:
            num = len(GOALS)
            specs[keys.OPTION_MASK] = Binary(num, shape=(self.num_envs, num), dtype=torch.bool, device=self.device)
        return specs

    def masks(self) -> dict[str, Tensor]:
        """Return which goals are open, if the agent chooses them."""
        return {keys.OPTION_MASK: rules.open_goals(self._state)} if self.options.chooses_goal else {}

    def _knowledge(self) -> dict[str, Any]:
        return super()._knowledge() | self.masks()

    def draw(self, track: Sequence[OfficeState]) -> np.ndarray:
        """Return a picture of the office and the way so far, uint8 `[480, 480, 3]`."""
        return rendering.draw(track)
