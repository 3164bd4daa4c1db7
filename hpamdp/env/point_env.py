"""A base for problems in which a point must reach a target in the plane."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Generic, Protocol, TypeVar

import numpy as np
from torch import Tensor

from hpamdp.env import point_pictures
from hpamdp.env.batched_env import EpisodeColumns, KernelEnv
from hpamdp.env.canvas import FAINT, PAPER
from hpamdp.env.point_agent import Located


class PointColumns(EpisodeColumns, Located, Protocol):
    """Columns `[N]` of episodes that include the positions of the agents and of their targets."""

    @property
    def target_x(self) -> Tensor:
        """The targets' x."""

    @property
    def target_y(self) -> Tensor:
        """The targets' y."""


PointEpisode = TypeVar("PointEpisode", bound=PointColumns)


class PointEnv(KernelEnv[PointEpisode], Generic[PointEpisode]):
    """A batch of environments in which a point must reach a target.

    For the constructor's arguments and errors see `BatchedEnv`.
    """

    target_radius: ClassVar[float]  # the distance that counts as a hit
    has_walls: ClassVar[bool] = False  # whether the agent must stay within the square

    def draw(self, track: Sequence[PointEpisode]) -> np.ndarray:
        """Return a picture of the agent's path to the target, uint8 `[480, 480, 3]`."""
        last = track[-1]
        picture = point_pictures.draw(
            [(float(state.x), float(state.y)) for state in track],
            (float(last.target_x), float(last.target_y)),
            self.target_radius,
            outcome=int(last.outcome),
            heading=self.heading(last),
            has_walls=self.has_walls,
        )
        picture.caption(int(last.steps), int(last.outcome), self.outcomes)
        picture.write((PAPER - 18.0, 22.0), self.picture_note(last), FAINT, anchor="rm")
        return np.array(picture.image)

    @abstractmethod
    def picture_note(self, state: PointEpisode) -> str:
        """Return a note for the picture of one environment's state, columns `[1]`.

        The picture shows it beside the number of steps.
        """

    def heading(self, state: PointEpisode) -> float | None:
        """Return the heading (rad) of one environment's agent, or None if the agent has no front."""
        return None
