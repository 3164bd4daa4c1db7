"""Gymnasium's observation spaces as vectors of float32, and how these are scaled.

Accepted are `Box`, `Discrete`, `MultiDiscrete`, `MultiBinary` and `Tuple` and `Dict` of these, flattened as
`gymnasium.spaces.utils.flatten` does, discrete values one-hot.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, get_args

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten, flatten_space
from torch import Tensor

from hpamdp.env.gymnasium.action_spaces import written

Scaling = Literal["bounds", "running", "none"]

# Bounds that are further apart than this stand for none: people write 1e10 or the largest float of all.
_WIDEST = 1e6
_CLIP = 10.0


class ObservationSpace:
    """A space whose observations are flattened and scaled.

    Args:
        space: see the module's docstring.
        scaling: `bounds` maps entries between finite bounds, at most a million apart, to [-1, 1] and leaves the others
            as they are; `running` brings all observations so far to mean 0 and standard deviation 1, clipped to +-10;
            `none`.

    Attributes:
        dim: how long the vectors are.
        statistics: of all observations so far, with `running`; None without.

    Raises:
        ValueError: the space or the scaling is none of those.
    """

    def __init__(self, space: spaces.Space, scaling: Scaling) -> None:
        if scaling not in get_args(Scaling):
            raise ValueError(f"observation_scaling={scaling!r}, but must be one of {', '.join(get_args(Scaling))}")
        if not _is_flat(space):
            accepted = "Box, Discrete, MultiDiscrete, MultiBinary and Tuple and Dict of these"
            raise ValueError(f"observation space {written(space)}; accepted are {accepted}")
        self._space = space
        self.dim = flatdim(space)
        self.statistics = RunningStatistics(self.dim) if scaling == "running" else None
        self._is_frozen = False
        self._centre, self._half_width = np.zeros(self.dim), np.ones(self.dim)
        if scaling == "bounds":
            box = flatten_space(space)
            low, high = box.low.astype(np.float64), box.high.astype(np.float64)
            with np.errstate(over="ignore"):
                is_bounded = (high - low > 0.0) & (high - low <= _WIDEST)
                self._centre = np.where(is_bounded, 0.5 * low + 0.5 * high, 0.0)
                self._half_width = np.where(is_bounded, 0.5 * (high - low), 1.0)

    def flat(self, observation: Any) -> np.ndarray:
        """Return an observation as a vector, float64 `[dim]`.

        Raises:
            ValueError: it has another length, or a value in it is not finite.
        """
        vector = np.asarray(flatten(self._space, observation), np.float64)
        if vector.shape != (self.dim,):
            raise ValueError(f"gave an observation of {vector.size} values, but its space has {self.dim}")
        if not np.isfinite(vector).all():
            raise ValueError("gave an observation that is not finite")
        return vector

    def scaled(self, vectors: np.ndarray) -> np.ndarray:
        """Return new observations `[M, dim]` scaled, float32; running statistics take them in first."""
        if self.statistics is None:
            return ((vectors - self._centre) / self._half_width).astype(np.float32)
        rows = torch.from_numpy(vectors)
        if not self._is_frozen:
            self.statistics.add(rows)
        return self.statistics.scaled(rows).clamp(-_CLIP, _CLIP).to(torch.float32).numpy()

    def share(self, other: ObservationSpace) -> None:
        """Scale by the statistics of `other`, as they are at every moment, and add nothing to them.

        Raises:
            ValueError: only one of the two has statistics, or theirs are of vectors of another length.
        """
        if (self.statistics is None) != (other.statistics is None) or self.dim != other.dim:
            raise ValueError(
                "scaling can be shared only by environments with the same observations and observation_scaling"
            )
        self.statistics, self._is_frozen = other.statistics, True


class RunningStatistics:
    """Mean and variance of all vectors so far, in double precision.

    Source: Chan, Golub and LeVeque 1979, *Updating formulae and a pairwise algorithm for computing sample variances*.

    Args:
        dim: how long the vectors are.
    """

    def __init__(self, dim: int) -> None:
        self._columns = {
            "observation_count": torch.zeros((), dtype=torch.float64),
            "observation_mean": torch.zeros(dim, dtype=torch.float64),
            # The sum of the squared distances from the mean.
            "observation_squares": torch.zeros(dim, dtype=torch.float64),
        }

    @property
    def mean(self) -> Tensor:
        """The mean, float64 `[dim]`."""
        return self._columns["observation_mean"]

    @property
    def variance(self) -> Tensor:
        """The variance, float64 `[dim]`."""
        return self._columns["observation_squares"] / self._columns["observation_count"].clamp(min=1.0)

    def add(self, rows: Tensor) -> None:
        """Take vectors `[M, dim]` in, M at least 1."""
        count, mean, squares = self._columns.values()
        total = count + len(rows)
        distance = rows.mean(0) - mean
        within = (rows - rows.mean(0)).square().sum(0)
        new = (total, mean + distance * len(rows) / total, squares + within + distance**2 * count * len(rows) / total)
        self._columns = dict(zip(self._columns, new, strict=True))

    def scaled(self, rows: Tensor) -> Tensor:
        """Return vectors `[M, dim]` less the mean in standard deviations; what never varied keeps its unit."""
        deviation = self.variance.sqrt()
        return (rows - self.mean) / torch.where(deviation > 1e-6, deviation, 1.0)

    def columns(self) -> dict[str, Tensor]:
        """Return a copy of all that there is to know, for a checkpoint."""
        return {name: column.clone() for name, column in self._columns.items()}

    def set_columns(self, columns: Mapping[str, Tensor]) -> None:
        """Go on where `columns` were taken.

        Raises:
            ValueError: they are of vectors of another length.
        """
        for name, column in self._columns.items():
            if name not in columns or columns[name].shape != column.shape:
                raise ValueError(f"running statistics: {name} must have shape {list(column.shape)}")
        self._columns = {name: columns[name].to("cpu", torch.float64, copy=True) for name in self._columns}


def _is_flat(space: spaces.Space) -> bool:
    if isinstance(space, spaces.Tuple | spaces.Dict):
        parts = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
        return all(map(_is_flat, parts))
    return isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary)
