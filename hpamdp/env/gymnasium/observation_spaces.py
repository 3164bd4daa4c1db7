"""Gymnasium's observation spaces as vectors of float32, and how these are scaled.

Accepted are `Box`, `Discrete`, `MultiDiscrete`, `MultiBinary` and `Tuple` and `Dict` of these. They are flattened by
`gymnasium.spaces.utils.flatten`, which makes discrete values one-hot; entries of a `Tuple` or `Dict` can be left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten_space
from gymnasium.wrappers.utils import RunningMeanStd
from torch import Tensor

from hpamdp.env.gymnasium.action_spaces import written
from hpamdp.env.gymnasium.leaves import Leaf, OutOfBounds, children, leaves
from hpamdp.settings import SettingError

Scaling = Literal["bounds", "running", "none"]

# Bounds further apart than this count as none: some environments write 1e10 or the largest float.
_WIDEST = 1e6
_CLIP = 10.0


class ObservationSpace:
    """A space whose observations are flattened and scaled.

    Args:
        space: see the module's docstring.
        scaling: `bounds` maps entries with finite bounds at most a million apart to [-1, 1] and leaves the others as
            they are; `running` normalises to mean 0 and standard deviation 1 over all observations so far and clips to
            [-10, 10]; `none` changes nothing.
        entries: of a `Tuple` (numbers from 0) or `Dict` (names), the ones to keep, in this order; None: all.
        out_of_bounds: what happens to numbers of a `Box` outside its bounds: `refuse`, `clip` or `allow`; see `Leaf`.

    Attributes:
        dim: length of the vectors.
        statistics: of all observations so far, with `running`; else None.

    Raises:
        ValueError: the space, the scaling or `out_of_bounds` is not accepted, or the space has no such entry.
    """

    def __init__(
        self,
        space: spaces.Space,
        scaling: Scaling,
        entries: Sequence[int | str] | None = None,
        out_of_bounds: OutOfBounds = "refuse",
    ) -> None:
        if scaling not in get_args(Scaling):
            raise SettingError(f"observation_scaling={scaling!r}, but must be one of {', '.join(get_args(Scaling))}")
        if not _is_flat(space):
            accepted = "Box, Discrete, MultiDiscrete, MultiBinary and Tuple and Dict of these"
            raise SettingError(f"observation space {written(space)}; accepted are {accepted}")
        self._names = list(children(space))
        self._leaves = list(leaves(space, out_of_bounds))
        if entries is not None:
            _check_entries(space, entries)
            self._leaves = [leaf for entry in entries for leaf in self._leaves if leaf.path[0] == entry]
        self._cures = [self._cure(leaf) for leaf in self._leaves]
        self._space = spaces.Tuple([leaf.space for leaf in self._leaves])
        self.dim = flatdim(self._space)
        self.statistics = RunningStatistics(self.dim) if scaling == "running" else None
        self._is_frozen = False
        self._centre = np.zeros(self.dim)
        self._half_width = np.ones(self.dim)
        if scaling == "bounds":
            self._read_bounds()

    def _read_bounds(self) -> None:
        box = flatten_space(self._space)
        assert isinstance(box, spaces.Box)  # as are all spaces that `_is_flat` lets pass
        low = box.low.astype(np.float64)
        high = box.high.astype(np.float64)
        has_both = np.isfinite(low) & np.isfinite(high)
        half_width = 0.5 * np.where(has_both, high, 0.0) - 0.5 * np.where(has_both, low, 0.0)
        is_bounded = (half_width > 0.0) & (half_width <= 0.5 * _WIDEST)
        self._centre = np.where(is_bounded, 0.5 * low + 0.5 * np.where(is_bounded, high, 0.0), 0.0)
        self._half_width = np.where(is_bounded, half_width, 1.0)

    def flat(self, observation: Any) -> np.ndarray:
        """Return an observation as a vector, float64 `[dim]`.

        Raises:
            ProblemError: an entry is missing or not in its space: see `Leaf`.
        """
        return np.concatenate(
            [leaf.flat(observation, cure) for leaf, cure in zip(self._leaves, self._cures, strict=True)]
        )

    def _cure(self, leaf: Leaf) -> str:
        """Return how to leave out the leaf's entry, as the end of a message; empty if there is no other entry."""
        others = [name for name in self._names if leaf.path and name != leaf.path[0]]
        return f"; env.observation_keys={others} leaves the entry out" if others else ""

    def scaled(self, vectors: np.ndarray) -> np.ndarray:
        """Return new observations `[M, dim]` scaled, float32; with `running`, they update the statistics first."""
        if self.statistics is None:
            return ((vectors - self._centre) / self._half_width).astype(np.float32)
        if not self._is_frozen:
            self.statistics.update(vectors)
        return self.statistics.normalised(vectors).clip(-_CLIP, _CLIP).astype(np.float32)

    def share(self, other: ObservationSpace) -> None:
        """Scale by the statistics of `other`, now and later, without updating them.

        Raises:
            ValueError: only one of the two has statistics, or their vectors differ in length.
        """
        if (self.statistics is None) != (other.statistics is None) or self.dim != other.dim:
            raise ValueError(
                "scaling can be shared only by environments with the same observations and observation_scaling"
            )
        self.statistics = other.statistics
        self._is_frozen = True


class RunningStatistics(RunningMeanStd):
    """Gymnasium's mean and variance of all vectors so far, float64 `[dim]`, that can be saved.

    Differs from the source: no prior observation of mean 0 and variance 1 is mixed in (`epsilon` is 0).

    Args:
        dim: length of the vectors.
    """

    def __init__(self, dim: int) -> None:
        super().__init__(epsilon=0.0, shape=(dim,))

    def normalised(self, vectors: np.ndarray) -> np.ndarray:
        """Return vectors `[M, dim]` minus the mean, in standard deviations; constant entries keep their unit."""
        deviation = np.sqrt(self.var)
        return (vectors - self.mean) / np.where(deviation > 1e-6, deviation, 1.0)

    def columns(self) -> dict[str, Tensor]:
        """Return a copy of the statistics, for a checkpoint."""
        return {
            "observation_count": torch.tensor(self.count, dtype=torch.float64),
            "observation_mean": torch.tensor(self.mean, dtype=torch.float64),
            "observation_variance": torch.tensor(self.var, dtype=torch.float64),
        }

    def set_columns(self, columns: Mapping[str, Tensor]) -> None:
        """Continue from saved `columns`.

        Raises:
            ValueError: they are of vectors of another length, or hold invalid numbers.
        """
        for name, column in self.columns().items():
            if name not in columns or columns[name].shape != column.shape:
                raise ValueError(f"running statistics: {name} must have shape {list(column.shape)}")
            is_mean = name == "observation_mean"
            if not (columns[name].isfinite() & (is_mean | (columns[name] >= 0.0))).all():
                raise ValueError(f"running statistics: {name} must be finite{'' if is_mean else ' and at least 0'}")
        self.count = columns["observation_count"].item()
        self.mean = columns["observation_mean"].to("cpu", torch.float64, copy=True).numpy()
        self.var = columns["observation_variance"].to("cpu", torch.float64, copy=True).numpy()


def _check_entries(space: spaces.Space, entries: Sequence[int | str]) -> None:
    names = list(children(space))
    if not names:
        raise SettingError(f"observation_keys={entries}: the observation {written(space)} has no entries; use null")
    wrong = [entry for entry in entries if entry not in names]
    if wrong or not entries or len(set(entries)) < len(entries):
        raise SettingError(f"observation_keys={entries}: must name different entries of {names}; null: all")


def _is_flat(space: spaces.Space) -> bool:
    """Return whether flattening the space gives a Box."""
    if isinstance(space, spaces.Tuple):
        return all(map(_is_flat, space.spaces))
    if isinstance(space, spaces.Dict):
        return all(map(_is_flat, space.spaces.values()))
    return isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary)
