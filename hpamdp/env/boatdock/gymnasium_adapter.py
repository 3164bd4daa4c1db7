"""The boat-docking task as Gymnasium environments: `BoatDock` (one boat), `BoatDockVector` (many).

Actions are dicts or, with `action_format="tuple"`, the field's nested tuples: see `hpamdp.env.boatdock.numpy_boats`.

Options of `reset`: `start` and `goal` `[2]` in screen px and, with these, `controller` (its number, not with
`controller="choose"`) and `keymap` (1 or 2). Infos: `outcome` (name), `fuel` (fraction of the tank), `presses`,
`controller` (its number, or -1 before one is chosen) and, once the episode is over, `score`.
"""

from __future__ import annotations

import itertools
from typing import Any, Literal

import numpy as np
from gymnasium.vector import AutoresetMode

from hpamdp.env.boatdock import task
from hpamdp.env.boatdock.numpy_boats import ActionFormat, NumpyBoats
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.gymnasium_adapter import GymnasiumAdapter, GymnasiumVectorAdapter


class BoatDock(GymnasiumAdapter):
    """One environment, with a boat to dock.

    Args:
        options: the settings; None for the defaults.
        action_format: `dict` or `tuple`; see `hpamdp.env.boatdock.numpy_boats`.
        render_mode: None or `rgb_array` (`render` returns uint8 `[480, 480, 3]`).
        settings: single settings by name, in place of those in `options`.

    `reset(seed=s)` starts with the first layout of seed s, `reset()` continues with the next one. The generators of
    torch, NumPy and Python are neither read nor moved.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the environment is unchanged.
    """

    def __init__(
        self,
        *,
        options: BoatDockOptions | None = None,
        action_format: ActionFormat = "dict",
        render_mode: Literal["rgb_array"] | None = None,
        **settings: Any,
    ) -> None:
        self._rules: BoatDockOptions = BoatDockOptions.of(options, settings)
        super().__init__(NumpyBoats(self._rules, (), action_format), render_mode)
        self.own_time_limit = task.MAX_PRESSES

    def _draw(self) -> np.ndarray:
        from hpamdp.env.boatdock import rendering  # it brings torch along

        state = self._track[-1]
        return rendering.draw(
            rendering.Scene(
                start=(state.start_x.item(), state.start_y.item()),
                goal=(state.goal_x.item(), state.goal_y.item()),
                boat=(state.x.item(), state.y.item()),
                heading=(state.velocity_x.item(), state.velocity_y.item()),
                legs=tuple(rendering.leg(*pair, self._rules.switch_cost) for pair in itertools.pairwise(self._track)),
                keymap=state.keymap.item(),
                boats=self._rules.own_boats,
                **self._problem.info(),
            )
        )


class BoatDockVector(GymnasiumVectorAdapter):
    """`num_envs` environments, each with a boat to dock.

    Args:
        num_envs: number of environments.
        options: the settings; None for the defaults.
        action_format: `dict` or `tuple`; see `hpamdp.env.boatdock.numpy_boats`.
        autoreset_mode: when finished environments start again. With `NextStep` they do in the next step, which ignores
            their actions. With `SameStep` they do in the same step; the last observations and infos are
            `infos["final_obs"]` and `infos["final_info"]`. With `Disabled` they do only by `reset`.
        settings: single settings by name, in place of those in `options`.

    `reset` takes one integer seed for all environments. The layouts of environment i depend only on the seed and i,
    not on `num_envs`. The options of `reset` have one row for each environment. `reset_mask` (bool `[N]`) resets only
    some.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the environments are unchanged.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        options: BoatDockOptions | None = None,
        action_format: ActionFormat = "dict",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **settings: Any,
    ) -> None:
        rules = BoatDockOptions.of(options, settings)
        super().__init__(NumpyBoats(rules, (num_envs,), action_format), num_envs, autoreset_mode)
