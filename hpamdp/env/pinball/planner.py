"""A hand-written player of Pinball: it looks up where to roll next, and pushes the ball to roll there.

The table is a grid of cells. Each cell has a shortest way to the hole that keeps a distance to the walls. Its entry is
the farthest place of this way that the ball can reach in a straight line. The player wants to roll there, more slowly
if the line is short, and pushes along the axis on which the ball's speed differs most.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from hpamdp.env.pinball import rules
from hpamdp.env.pinball.maps import MapError, PinballMap
from hpamdp.env.pinball.rules import PinballState

_CELLS = 100  # in a row
_MARGIN = 0.002  # from walls, on straight lines
_ROOMY = 0.03  # a way nearer to a wall than this beside the ball counts as longer
_NARROW = 8.0  # by up to this factor
_BLOCKED = 1_000.0  # factor on ways through places where the ball does not fit
_FARTHEST = 60  # cells of its way that a player looks ahead
_FASTEST, _SLOWEST = 1.2, 0.3  # speeds
_PER_ROOT = 4.0  # speed for each root of a distance
_TOLERANCE = 0.15  # difference of speeds that needs no push


class Planner:
    """The player on one map.

    Raises:
        MapError: no way leads from the start to the hole.
    """

    def __init__(self, table: PinballMap, device: Any = None) -> None:
        middle = (np.arange(_CELLS) + 0.5) / _CELLS
        self._middles = np.stack(np.meshgrid(middle, middle, indexing="ij"), -1).reshape(-1, 2)
        self._clearance = table.clearance(self._middles) - table.ball
        following = self._ways(np.array(table.target[:2]))
        begin = self._cell(np.array(table.start))
        if not self._is_way(int(begin), following):
            raise MapError("start: no way leads from there to the target")
        self._aim = torch.from_numpy(self._aims(following)).to(device=device, dtype=torch.float32)

    def __call__(self, state: PinballState) -> tuple[Tensor, Tensor]:
        """Return the discrete action, int64 `[N]`, and its strength `[N]`."""
        place = torch.stack([state.x, state.y], -1)
        column, row = (place * _CELLS).long().clamp(0, _CELLS - 1).unbind(-1)
        to_aim = self._aim[column * _CELLS + row] - place
        distance = to_aim.norm(dim=-1, keepdim=True).clamp(min=1e-6)
        speed = (_PER_ROOT * distance.sqrt()).clamp(_SLOWEST, _FASTEST)
        lack = to_aim / distance * speed - torch.stack([state.vx, state.vy], -1)
        axis = lack.abs().argmax(-1)
        wanted = lack.gather(-1, axis.unsqueeze(-1)).squeeze(-1)
        push = axis + 2 * (wanted < 0.0)  # right, up, left, down
        is_enough = wanted.abs() < _TOLERANCE
        strength = (wanted / rules.PUSH).clamp(-1.0, 1.0)
        return torch.where(is_enough, rules.NONE, push), torch.where(is_enough, 0.0, strength)

    @staticmethod
    def _cell(places: np.ndarray) -> np.ndarray:
        """Return the numbers of the cells of places `[..., 2]`."""
        column, row = np.moveaxis(np.clip((places * _CELLS).astype(np.int64), 0, _CELLS - 1), -1, 0)
        return column * _CELLS + row

    def _ways(self, target: np.ndarray) -> np.ndarray:
        """Return the next cell of each cell's shortest way to the target, `[C]`; negative at the target itself."""
        columns, rows = np.divmod(np.arange(_CELLS**2), _CELLS)
        # Ways through narrow places are longer, and through walls much longer, so that every cell has one.
        room = np.clip(self._clearance / _ROOMY, 0.0, 1.0)
        factor = np.where(self._clearance < 0.0, _BLOCKED, _NARROW + (1.0 - _NARROW) * room)
        begins, ends, lengths = [], [], []
        for right, up in ((1, 0), (0, 1), (1, 1), (1, -1)):
            exists = (columns + right < _CELLS) & (rows + up >= 0) & (rows + up < _CELLS)
            begin = np.flatnonzero(exists)
            end = begin + right * _CELLS + up
            begins.append(begin)
            ends.append(end)
            lengths.append(np.hypot(right, up) * 0.5 * (factor[begin] + factor[end]))
        graph = coo_matrix(
            (np.concatenate(lengths), (np.concatenate(begins), np.concatenate(ends))), shape=(_CELLS**2, _CELLS**2)
        )
        target_cell = int(self._cell(target))
        return dijkstra(graph.tocsr(), directed=False, indices=target_cell, return_predecessors=True)[1]

    def _is_way(self, cell: int, following: np.ndarray) -> bool:
        """Return whether the ball fits everywhere on a cell's way."""
        while cell >= 0:
            if self._clearance[cell] < 0.0:
                return False
            cell = int(following[cell])
        return True

    def _aims(self, following: np.ndarray) -> np.ndarray:
        """Return the farthest place of each cell's way that lies in a straight line, `[C, 2]`."""
        aim = np.where(following >= 0, following, np.arange(_CELLS**2))
        ahead, seen = aim.copy(), np.arange(_CELLS**2)
        fractions = np.linspace(0.0, 1.0, _FARTHEST)[:, None, None]
        for _ in range(_FARTHEST):
            ahead = np.where(following[ahead] >= 0, following[ahead], ahead)
            begins, ends = self._middles[seen], self._middles[ahead[seen]]
            clearance = self._clearance[self._cell(begins + fractions * (ends - begins))]
            seen = seen[(clearance >= _MARGIN).all(0)]
            aim[seen] = ahead[seen]
        return self._middles[aim]
