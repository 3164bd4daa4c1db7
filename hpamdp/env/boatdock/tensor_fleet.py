"""Boats in NumPy arrays that BoatDockEnv moves with its tensor functions: on a GPU, or compiled."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from hpamdp import keys
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.episode import FUEL
from hpamdp.env.boatdock.fleet import Readings
from hpamdp.env.boatdock.kernel import OUTCOME
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.task import SAILING, BoatState


class TensorFleet:
    """What `Fleet` is, for the settings that the kernel does not have; see there.

    Args:
        num_boats: how many.
        options: the settings of the environment.
        device: of the environment.
    """

    def __init__(self, num_boats: int, options: BoatDockOptions, *, device: torch.device | str) -> None:
        self._env = BoatDockEnv(num_boats, options=options, device=device)

    @property
    def floats(self) -> np.ndarray:
        """The float32 columns of the state, `[9, N]`."""
        return np.stack(self.columns()[:9])

    @property
    def integers(self) -> np.ndarray:
        """The int32 columns of the state, `[5, N]`."""
        return np.stack(self.columns()[9:])

    def set_seed(self, seed: int, *, is_evaluation: bool) -> None:
        """Put all boats before their first episode."""
        self._env.set_seed(seed, static_seed=True)
        if is_evaluation:
            self._env.seed_evaluation(seed)

    def columns(self) -> BoatState:
        """Return copies of the columns."""
        return BoatState(*(column.cpu().numpy().copy() for column in self._env.state))

    def put(self, columns: Mapping[str, np.ndarray], mask: np.ndarray | None) -> None:
        """Set columns of the state by name."""
        state = self.columns()
        for name, column in columns.items():
            np.copyto(getattr(state, name), column, where=True if mask is None else mask)
        self._env.state = BoatState(*(torch.from_numpy(column) for column in state))

    def press(self, option: np.ndarray | None, key: np.ndarray, durations: np.ndarray) -> tuple[Readings, np.ndarray]:
        """Press a key in every boat; an invalid action raises the environment's own error."""
        td = TensorDict(batch_size=self._env.batch_size, device=self._env.device)
        td[keys.DISCRETE], td[keys.PARAMETERS] = torch.from_numpy(key), torch.from_numpy(durations)
        if option is not None:
            td[keys.OPTION] = torch.from_numpy(option)
        after = self._env.step(td)["next"]
        return _readings(after), after[keys.REWARD][:, 0].cpu().numpy()

    def press_or_restart(
        self, option: np.ndarray | None, key: np.ndarray, durations: np.ndarray
    ) -> tuple[Readings, np.ndarray]:
        """Press a key, and instead start a new episode where one is over."""
        was_over = self.integers[OUTCOME] != SAILING
        option = None if option is None else np.where(was_over, 0, option)
        key, durations = np.where(was_over, 0, key), np.where(was_over[:, None], np.float32(0.0), durations)
        readings, rewards = self.press(option, key, durations)
        return (self.restart(was_over) if was_over.any() else readings), rewards

    def restart(self, mask: np.ndarray | None = None) -> Readings:
        """Start new episodes, in the rows of `mask` or in all."""
        td = TensorDict(batch_size=self._env.batch_size, device=self._env.device)
        if mask is not None:
            td["_reset"] = torch.from_numpy(mask.copy()).unsqueeze(-1)
        return _readings(self._env.reset(td))

    def read(self) -> Readings:
        """Return what the boats observe."""
        return self.restart(np.zeros(self._env.num_envs, np.bool_))


def _readings(td: TensorDictBase) -> Readings:
    flags = np.stack([td[name][:, 0].cpu().numpy() for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)])
    columns = (td[keys.OBSERVATION], td[keys.OUTCOME], td[FUEL][:, 0])
    observations, outcomes, fuel = (column.cpu().numpy().copy()[None] for column in columns)
    return Readings(observations, outcomes, fuel, flags[None])
