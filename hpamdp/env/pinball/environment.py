"""Pinball as a batched TorchRL environment: push a ball between walls into a hole.

Source: Konidaris and Barto 2009; see `hpamdp.env.pinball.rules`, also for the differences.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from hpamdp.env.batched_env import KernelEnv
from hpamdp.env.pinball import maps, rendering, rules
from hpamdp.env.pinball.options import CARDS, SOURCE_MAPS, PinballOptions
from hpamdp.env.pinball.planner import Planner
from hpamdp.env.pinball.rules import PinballState
from hpamdp.env.tiles import bounds_with_tiles, tile_names
from hpamdp.settings import SettingError

_GRID = 100  # places in a row from which a ball may start anywhere
_SCRIPTED = {"simple": 9_837.0, "hard": 9_404.0}  # returns of the hand-written player from the start of the map


class PinballEnv(KernelEnv[PinballState]):
    """Push a ball into the hole on `num_envs` tables at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 right, 1 up, 2 left, 3 down, 4 none; `("action",
    "parameters")` float32 `[N, 4]`: the strengths of a push to the right and upwards in [0, 1], to the left and
    downwards in [-1, 0]. Only the strength of the chosen push counts; outside its bounds it is clipped, NaN and
    infinity are refused. A push changes the speed once, by a fifth of its strength; the ball keeps rolling.

    A push costs 5 and none costs 1. The step in which the ball reaches the hole has the reward 10,000 instead, and ends
    the episode.

    Nothing is random, except starts that are `anywhere`. For the constructor's arguments and errors see
    `BatchedEnv`.
    """

    Options = PinballOptions
    card = CARDS["PinballEnv"]
    options: PinballOptions
    discrete_names = rules.ACTIONS
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    parameter_dims = rules.PARAMETER_DIMS
    parameter_low = rules.PARAMETER_LOW
    parameter_high = rules.PARAMETER_HIGH
    row_kernel = staticmethod(rules.advance)
    state_type = PinballState
    num_columns = (4, 3)
    seconds_per_step: ClassVar[float] = 0.04

    def _prepare(self) -> None:
        try:
            self.map = maps.read(self.options.map)
            self._places = _places(self.map, self.options.start)
            self._training_places = _places(self.map, self.options.training_start or self.options.start)
            self._planner = Planner(self.map, self.device) if self._has_oracle else None
        except maps.MapError as error:
            raise SettingError(f"map={self.options.map!r}: {error}") from error
        self.observation_names = rules.OBSERVATION_NAMES + tile_names(self.options.tiles)

    @property
    def training_begins_elsewhere(self) -> bool:
        """Whether episodes of training begin at other places than those of evaluation."""
        return self.options.training_start not in (None, self.options.start)

    def kernel_settings(self) -> Sequence[float]:
        """Return the tiles and the map in numbers."""
        return rules.settings_of(self.map, (self._training_places, self._places), self.options.tiles)

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]]:
        """The lowest and the highest observation, `[4 + 2 tiles]` each."""
        return bounds_with_tiles(len(rules.OBSERVATION_NAMES), self.options.tiles)

    def file_checksums(self) -> dict[str, Tensor]:
        """Return the checksum of a map that is not the source's, int64 `[1]`; nothing for the source's maps."""
        if self.options.map in SOURCE_MAPS:
            return {}
        checksum = zlib.crc32(self.map.model_dump_json().encode())
        return {"map_checksum": torch.tensor([checksum], dtype=torch.int64, device=self.device)}

    def scripted_action(self, state: PinballState) -> tuple[Tensor, Tensor]:
        """Return the action of the hand-written player and its strength, `[N]` each."""
        if self._planner is None:
            self._planner = Planner(self.map, self.device)
        return self._planner(state)

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the figures of the hand-written player from the start of a map of the source."""
        is_published = self.options.start == "map" and self.max_steps == 600 and self.options.map in _SCRIPTED
        return {"scripted": {"score": _SCRIPTED[self.options.map], "success": 1.0}} if is_published else {}

    def draw(self, track: Sequence[PinballState]) -> np.ndarray:
        """Return a picture of the table and the way of the ball, uint8 `[480, 480, 3]`."""
        return rendering.draw(track, self.map)


def _places(found: maps.PinballMap, start: str) -> np.ndarray:
    """Return where episodes begin, `[S, 2]`, for a value of the setting `start`."""
    if start == "map":
        return np.array([found.start], np.float64)
    places = found.free_places(_GRID)
    if not len(places):
        raise maps.MapError(f"the ball lies free at no place of a grid of {_GRID} x {_GRID}; begin at the map's start")
    if start == "both":
        return np.concatenate([places, np.tile(found.start, (len(places), 1))])
    return places
