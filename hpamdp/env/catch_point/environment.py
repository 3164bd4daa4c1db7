"""Catch Point as a batched TorchRL environment: move a point to a target and catch it there.

Source: Fan et al. 2019, arXiv:1903.01344, in the version of Li et al. 2022, arXiv:2109.05490; see
`hpamdp.env.catch_point.rules`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from hpamdp.env import point_agent
from hpamdp.env.catch_point import kernel, picture, rules
from hpamdp.env.catch_point.options import CARDS, PUBLISHED_CATCHES, CatchPointOptions
from hpamdp.env.catch_point.rules import CatchPointState
from hpamdp.env.point_env import PointEnv
from hpamdp.geometry import PlaneGeometry, Symmetries, make_symmetries, on_observations, plane_maps
from hpamdp.observation_entries import ObservationEntry

_TURNS = 8  # turns of the plane that are declared as symmetries
_CEILING = {25: 0.964, 30: 0.997}  # highest success by `max_steps`: from some starts the target is out of reach


class CatchPointEnv(PointEnv[CatchPointState]):
    """Catch the target in `num_envs` planes at once.

    Action leaves: `("action", "discrete")` int64 `[N]`: 0 move, 1 catch; `("action", "parameters")` float32 `[N, 1]`:
    the direction of a move in [-1, 1], a fraction of half a turn, clockwise from +y. A move always has full force.
    Directions outside are clipped; NaN and infinity are refused. A catch has no parameter.

    The reward is minus the squared distance after each step, plus 20 for a catch within 0.2 of the target, which ends
    the episode. A catch elsewhere is a miss.

    Only the start is random. For the constructor's arguments and errors see `BatchedEnv`.
    """

    Options = CatchPointOptions
    card = CARDS["CatchPointEnv"]
    options: CatchPointOptions
    discrete_names = rules.ACTIONS
    outcomes: ClassVar[tuple[str, ...]] = rules.OUTCOMES
    parameter_dims = (1, 0)
    parameter_low = (-1.0,)
    parameter_high = (1.0,)
    row_kernel = staticmethod(kernel.advance)
    state_type = CatchPointState
    num_columns = (6, 4)
    target_radius = point_agent.HIT_RADIUS

    def _prepare(self) -> None:
        self.observation_names = point_agent.OBSERVATION_NAMES + (rules.PROGRESS_NAMES if self.options.progress else ())
        self._shows_picture = self.options.observation == "picture"
        if self._shows_picture and not self._flattens:
            self.observation_entries = (ObservationEntry("picture", 0, picture.SHAPE, is_picture=True),)

    def observed_spec(self) -> TensorSpec:
        """Return the spec of vectors, of pictures, or of flattened pictures."""
        if not self._shows_picture:
            return super().observed_spec()
        shape = (self.num_envs, math.prod(picture.SHAPE))
        dtype = torch.float32 if self._flattens else torch.uint8
        return Bounded(0, 1 if self._flattens else 255, shape=shape, device=self.device, dtype=dtype)

    def shown(self, vectors: Tensor) -> Tensor:
        """Return the vectors, or pictures of them, drawn by the CPU."""
        if not self._shows_picture:
            return vectors
        pixels = np.empty((len(vectors), *picture.SHAPE), np.uint8)
        longest_time, most_misses = self.max_steps / 12.0 - 1.0, PUBLISHED_CATCHES / 6.0 - 1.0
        picture.draw(vectors.detach().numpy(force=True), longest_time, most_misses, pixels)
        pictures = torch.from_numpy(pixels).flatten(1).to(vectors.device)
        return pictures.float() / 255.0 if self._flattens else pictures

    def kernel_settings(self) -> Sequence[float]:
        """Return the rules of catches, and whether progress is observed."""
        return [self.options.catches, self.options.late_end, self.options.progress]

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]]:
        """The lowest and the highest observation, `[4]` or `[6]` each."""
        low, high = point_agent.observation_bounds(self.max_steps)
        if not self.options.progress:
            return low, high
        return [*low, -1.0, -1.0], [*high, 1.0, self.max_steps / 12.0 - 0.99]

    @property
    def symmetries(self) -> Symmetries | None:
        """Turns of the plane by multiples of 45 degrees and their mirrors; any other turn would do as well.

        None with pictures, since a symmetry maps vectors linearly.
        """
        if self._shows_picture:
            return None
        plane = plane_maps(_TURNS)
        weight, offset = on_observations(plane, len(self.observation_names), point_agent.VECTORS)
        # A direction runs from +y to +x, so a turn by a, from +x to +y, makes p into p - a; the mirror x -> -x before
        # it makes p into -p.
        turn = 2.0 * torch.arange(_TURNS).repeat(2) / _TURNS
        sign = torch.ones(2 * _TURNS, dtype=torch.float32).index_fill(0, torch.arange(_TURNS, 2 * _TURNS), -1.0)
        return make_symmetries(
            weight,
            offset=offset,
            discrete=torch.arange(len(rules.ACTIONS)).expand(2 * _TURNS, -1),
            sign=sign.unsqueeze(-1),
            shift=-turn.unsqueeze(-1),
            is_periodic=[True],
            num_parameters=1,
        )

    @property
    def geometry(self) -> PlaneGeometry | None:
        """The speed and the way to the target; where a move points is its parameter. None with pictures."""
        return None if self._shows_picture else PlaneGeometry(vectors=point_agent.VECTORS)

    def scripted_action(self, state: CatchPointState) -> tuple[Tensor, Tensor]:
        """Return the action of the hand-written player and its parameter, `[N]` each."""
        return rules.scripted_action(state)

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the hand-written player's figures, and the fraction of starts from which the target is in reach."""
        ceiling = {"ceiling": {"success": _CEILING[self.max_steps]}} if self.max_steps in _CEILING else {}
        is_published = (self.max_steps, self.options.catches, self.options.late_end) == (
            25,
            PUBLISHED_CATCHES,
            True,
        )
        return ({"scripted": {"score": 8.73, "success": 0.964}} if is_published else {}) | ceiling

    def picture_note(self, state: CatchPointState) -> str:
        """Return how many catches have missed."""
        misses = int(state.misses)
        return f"{misses} {'miss' if misses == 1 else 'misses'}"
