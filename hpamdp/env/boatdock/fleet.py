"""Boats as NumPy arrays that the kernel moves; nothing here needs torch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hpamdp.env.boatdock import kernel, task
from hpamdp.env.boatdock.kernel import PRESS, PRESS_AND_RESTART, PRESS_OR_RESTART, RESTART
from hpamdp.env.boatdock.task import BoatState, Rules
from hpamdp.env.kernels import folded
from hpamdp.env.rng_streams import EVALUATION, EVALUATION_NOISE, NOISE, TRAINING


class Readings(NamedTuple):
    """What R readings of N boats say; R is 2 where the boats that finished started anew, before and after that.

    `observations` float32 `[R, N, D]`, `outcomes` int64 `[R, N]`, `fuel` (fraction) float32 `[R, N]` and `flags` bool
    `[R, 3, N]`: done, terminated, truncated.
    """

    observations: np.ndarray
    outcomes: np.ndarray
    fuel: np.ndarray
    flags: np.ndarray


class Fleet:
    """`num_boats` boats.

    Args:
        num_boats: how many.
        rules: of the environment.
        first_env: number of the first boat, where other processes have those before it.
    """

    def __init__(self, num_boats: int, rules: Rules, first_env: int) -> None:
        self.num_boats = num_boats
        self.floats = np.zeros((9, num_boats), np.float32)
        self.integers = np.zeros((5, num_boats), np.int32)
        self._rules = rules
        self._first_env = first_env
        self._observation_dim = len(task.OBSERVATION_NAMES if rules.observation == "pixels" else task.SCALED_NAMES)
        self._all = np.ones(num_boats, np.bool_)
        # What a start reads of actions.
        self._no_option = np.zeros(num_boats, np.int64)
        self._no_durations = np.zeros((num_boats, task.NUM_KEYS), np.float32)
        self.set_seed(0, is_evaluation=False)

    def set_seed(self, seed: int, *, is_evaluation: bool) -> None:
        """Put all boats before their first episode, whose random numbers depend on the seed."""
        rules = self._rules
        self.floats[:] = 0.0
        self.integers[:] = 0
        self.integers[kernel.EPISODE] = -1
        self._settings = np.zeros(kernel.NUM_SETTINGS + len(rules.names) * kernel.NUM_BOAT_SETTINGS)
        self._settings[kernel.SEED] = folded(seed)
        self._settings[kernel.FIRST_ENV] = self._first_env
        special = {"choose": task.NOT_CHOSEN, "random": kernel.RANDOM}
        controller = rules.controller
        number = special[controller] if controller in special else rules.names.index(controller)
        self._settings[kernel.SET_CONTROLLER] = number
        self._settings[kernel.SET_KEYMAP] = kernel.RANDOM if rules.keymap == "random" else rules.keymap
        self._settings[kernel.IS_SPARSE] = rules.reward == "sparse"
        self._settings[kernel.IS_PIXELS] = rules.observation == "pixels"
        self._settings[kernel.SENSOR_NOISE] = rules.sensor_noise
        self._settings[kernel.SLIP_CHANCE] = rules.slip
        self._settings[kernel.NUM_BOATS] = len(rules.names)
        self._settings[kernel.HAS_KEYMAPS] = rules.boats is None
        self._settings[kernel.SWITCH_COST] = -1.0 if rules.switch_cost is None else rules.switch_cost
        of_boats = self._settings[kernel.NUM_SETTINGS :].reshape(len(rules.names), -1)
        of_boats[:, 0] = rules.motor_noise
        if rules.boats is not None:
            of_boats[:, 1:] = np.array(rules.boats.directions).reshape(len(rules.names), -1)
        self.set_streams(is_evaluation=is_evaluation)

    def set_streams(self, *, is_evaluation: bool) -> None:
        """Draw the random numbers of episodes and noise from the streams of evaluation or of training."""
        self._settings[kernel.EPISODE_STREAM] = EVALUATION if is_evaluation else TRAINING
        self._settings[kernel.NOISE_STREAM] = EVALUATION_NOISE if is_evaluation else NOISE

    def columns(self) -> BoatState:
        """Return the state, columns `[N]` that change with the boats."""
        return BoatState(*self.floats, *self.integers)

    def put(self, columns: Mapping[str, np.ndarray], mask: np.ndarray | None) -> None:
        """Set columns of the state by name, in the rows of `mask` or in all."""
        state = self.columns()
        for name, column in columns.items():
            np.copyto(getattr(state, name), column, where=True if mask is None else mask)

    def press(
        self,
        option: np.ndarray | None,
        key: np.ndarray,
        durations: np.ndarray,
        *,
        mask: np.ndarray | None = None,
        restarts: bool = False,
    ) -> tuple[Readings, np.ndarray] | int:
        """Press a key in every boat; those whose episode is over stay as they are.

        Args:
            option: int64 `[N]`, the controllers of boats that have none yet, with a `switch_cost` of all; None where
                nobody chooses.
            key: int64 `[N]`.
            durations: seconds, float32 `[N, 3]`.
            mask: bool `[N]`, the boats that move; all by default.
            restarts: read the boats, start new episodes where they are over, and read them again.

        Returns:
            The readings and the rewards float32 `[N]`, or the number of the first boat whose action is invalid, where
            nothing has changed.
        """
        return self._advance(PRESS_AND_RESTART if restarts else PRESS, option, key, durations, mask)

    def press_or_restart(
        self, option: np.ndarray | None, key: np.ndarray, durations: np.ndarray
    ) -> tuple[Readings, np.ndarray] | int:
        """Press a key, and instead start a new episode where one is over; actions are not read there."""
        return self._advance(PRESS_OR_RESTART, option, key, durations, None)

    def restart(self, mask: np.ndarray | None = None) -> Readings:
        """Start new episodes, in the rows of `mask` bool `[N]` or in all."""
        result = self._advance(RESTART, None, self._no_option, self._no_durations, mask)
        assert not isinstance(result, int)
        return result[0]

    def read(self) -> Readings:
        """Return what the boats observe."""
        return self.restart(~self._all)

    def _advance(
        self, mode: int, option: np.ndarray | None, key: np.ndarray, durations: np.ndarray, mask: np.ndarray | None
    ) -> tuple[Readings, np.ndarray] | int:
        num_readings, n = 2 if mode == PRESS_AND_RESTART else 1, self.num_boats
        readings = Readings(
            np.empty((num_readings, n, self._observation_dim), np.float32),
            np.empty((num_readings, n), np.int64),
            np.empty((num_readings, n), np.float32),
            np.empty((num_readings, 3, n), np.bool_),
        )
        rewards = np.empty(n, np.float32)
        option = self._no_option if option is None else option
        mask = self._all if mask is None else mask
        invalid = kernel.advance(
            self.floats, self.integers, option, key, durations, mask, self._settings, mode, rewards, *readings
        )
        return (readings, rewards) if invalid < 0 else invalid
