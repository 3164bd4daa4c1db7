"""The boat-docking task as Gymnasium environments over BoatDockEnv: `BoatDock` (one boat), `BoatDockVector` (many).

Actions are dicts or, with `action_format="tuple"`, the field's nested tuples: see `hpamdp.env.boatdock.numpy_boats`.

Options of `reset`: `start` and `goal` `[2]` in screen px and, with these, `controller` (0 or 1, not with
`controller="choose"`) and `keymap` (1 or 2). Infos: `outcome` (name), `fuel` (fraction of the tank), `presses`,
`controller` (0, 1, or -1 before one is chosen) and, once the episode is over, `score`.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from hpamdp.env.boatdock import physics, rendering
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.episode import BoatState
from hpamdp.env.boatdock.numpy_boats import ActionFormat, NumpyBoats
from hpamdp.env.faces import Face, VectorFace


class BoatDock(Face):
    """One boat to dock.

    Args:
        controller, keymap, reward, observation, motor_noise, sensor_noise, slip: the task, as in BoatDockEnv.
        action_format: `dict` or `tuple`; see `hpamdp.env.boatdock.numpy_boats`.
        render_mode: None or `rgb_array` (`render` returns uint8 `[480, 480, 3]`).

    `reset(seed=s)` starts with the first layout of seed s, `reset()` continues with the next one. The generators of
    torch, NumPy and Python are neither read nor moved.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the boat is unchanged.
    """

    def __init__(
        self,
        *,
        controller: Literal["choose", "congruent", "incongruent", "random"] = "choose",
        keymap: Literal[1, 2, "random"] = 1,
        reward: Literal["paper", "sparse"] = "paper",
        observation: Literal["scaled", "pixels"] = "scaled",
        motor_noise: float | Sequence[float] = 0.0,
        sensor_noise: float = 0.0,
        slip: float = 0.0,
        action_format: ActionFormat = "dict",
        render_mode: Literal["rgb_array"] | None = None,
    ) -> None:
        env = BoatDockEnv(
            1,
            controller=controller,
            keymap=keymap,
            reward=reward,
            observation=observation,
            motor_noise=_one_or_two(motor_noise),
            sensor_noise=sensor_noise,
            slip=slip,
        )
        super().__init__(NumpyBoats(env, (), action_format), render_mode)

    def _draw(self) -> np.ndarray:
        state = self._track[-1]
        return rendering.draw(
            rendering.Scene(
                start=(state.start_x.item(), state.start_y.item()),
                goal=(state.goal_x.item(), state.goal_y.item()),
                boat=(state.x.item(), state.y.item()),
                heading=(state.velocity_x.item(), state.velocity_y.item()),
                legs=tuple(_leg(*pair) for pair in itertools.pairwise(self._track)),
                keymap=int(state.keymap),
                **self._info(),
            )
        )


def _one_or_two(motor_noise: float | Sequence[float]) -> float | list[float]:
    """Return the motor noise as BoatDockEnv takes it."""
    return motor_noise if isinstance(motor_noise, int | float) else list(motor_noise)


def _leg(before: BoatState, after: BoatState) -> rendering.Leg:
    """Return the track of the press between two states of one boat."""
    start = (before.x.item(), before.y.item())
    end = (after.x.item(), after.y.item())
    # The fuel burnt is the time that the key was down, after noise and with what was left in the tank.
    pressed = physics.pressed_distance(before.fuel - after.fuel).item()
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    return rendering.Leg(start, end, min(pressed / length, 1.0) if length > 0.0 else 1.0)


class BoatDockVector(VectorFace):
    """`num_envs` boats to dock in one BoatDockEnv.

    Args:
        num_envs: number of boats.
        controller, keymap, reward, observation, motor_noise, sensor_noise, slip: the task, as in BoatDockEnv.
        action_format: `dict` or `tuple`; see `hpamdp.env.boatdock.numpy_boats`.
        autoreset_mode: when finished boats start again: in the next step (which ignores their actions), in the same
            step (the last observations and infos are `infos["final_obs"]` and `infos["final_info"]`), or only by
            `reset`.
        compile_rules, device: as in BoatDockEnv.

    `reset` takes one integer seed for all boats; the layouts of boat i depend only on the seed and i, not on
    `num_envs`. The options of `reset` have one row for each boat; `reset_mask` (bool `[N]`) resets only these boats.

    Raises:
        ValueError: an argument, an action or a reset option is invalid; the boats are unchanged.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        controller: Literal["choose", "congruent", "incongruent", "random"] = "choose",
        keymap: Literal[1, 2, "random"] = 1,
        reward: Literal["paper", "sparse"] = "paper",
        observation: Literal["scaled", "pixels"] = "scaled",
        motor_noise: float | Sequence[float] = 0.0,
        sensor_noise: float = 0.0,
        slip: float = 0.0,
        action_format: ActionFormat = "dict",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        compile_rules: bool = False,
        device: torch.device | str = "cpu",
    ) -> None:
        env = BoatDockEnv(
            num_envs,
            controller=controller,
            keymap=keymap,
            reward=reward,
            observation=observation,
            motor_noise=_one_or_two(motor_noise),
            sensor_noise=sensor_noise,
            slip=slip,
            compile_rules=compile_rules,
            device=device,
        )
        super().__init__(NumpyBoats(env, (num_envs,), action_format), num_envs, autoreset_mode)
