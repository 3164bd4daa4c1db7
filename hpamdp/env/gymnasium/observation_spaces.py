"""Gymnasium's observation spaces as vectors of float32, and how these are scaled.

Accepted are `Box`, `Discrete`, `MultiDiscrete`, `MultiBinary` and `Tuple` and `Dict` of these. They are flattened by
`gymnasium.spaces.utils.flatten`, which makes discrete values one-hot; entries of a `Tuple` or `Dict` can be left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim, flatten, flatten_space
from gymnasium.wrappers.utils import RunningMeanStd
from torch import Tensor

from hpamdp.env.base import ProblemError
from hpamdp.env.gymnasium.action_spaces import written

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

    Attributes:
        dim: length of the vectors.
        statistics: of all observations so far, with `running`; else None.

    Raises:
        ValueError: the space or the scaling is not accepted, or the space has no such entry.
    """

    def __init__(self, space: spaces.Space, scaling: Scaling, entries: Sequence[int | str] | None = None) -> None:
        if scaling not in get_args(Scaling):
            raise ValueError(f"observation_scaling={scaling!r}, but must be one of {', '.join(get_args(Scaling))}")
        if not _is_flat(space):
            accepted = "Box, Discrete, MultiDiscrete, MultiBinary and Tuple and Dict of these"
            raise ValueError(f"observation space {written(space)}; accepted are {accepted}")
        self._names = list(_children(space))
        self._leaves = list(_leaves(space))
        if entries is not None:
            _check_entries(space, entries)
            self._leaves = [(path, leaf) for entry in entries for path, leaf in self._leaves if path[0] == entry]
        self._space = spaces.Tuple([leaf for _, leaf in self._leaves])
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
        with np.errstate(over="ignore"):
            is_bounded = (high - low > 0.0) & (high - low <= _WIDEST)
            self._centre = np.where(is_bounded, 0.5 * low + 0.5 * high, 0.0)
            self._half_width = np.where(is_bounded, 0.5 * (high - low), 1.0)

    def flat(self, observation: Any) -> np.ndarray:
        """Return an observation as a vector, float64 `[dim]`.

        Raises:
            ProblemError: an entry is missing or outside its space, the observation has another length, or a value is
                not finite.
        """
        vector = np.concatenate([self._flat_leaf(path, leaf, observation) for path, leaf in self._leaves])
        if vector.shape != (self.dim,):
            raise ProblemError(f"gave an observation of {vector.size} values, but its space has {self.dim}")
        if not np.isfinite(vector).all():
            raise ProblemError("gave an observation that is not finite")
        return vector

    def _flat_leaf(self, path: tuple[int | str, ...], leaf: spaces.Space, observation: Any) -> np.ndarray:
        value = observation
        try:
            for entry in path:
                value = value[entry]
        except (LookupError, TypeError) as error:
            raise ProblemError(f"gave an observation without its {_written_path(path)}") from error
        if not _is_inside(leaf, value):
            others = [name for name in self._names if name != path[0]] if path else []
            cure = f"; env.observation_keys={others} leaves the entry out" if others else ""
            raise ProblemError(f"gave an observation whose {_written_path(path)} is {value}, outside {leaf}{cure}")
        try:
            return np.asarray(flatten(leaf, value), np.float64)
        except (TypeError, ValueError) as error:
            raise ProblemError(f"gave an observation whose {_written_path(path)} is {value!r}, not numbers") from error

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
            ValueError: they are of vectors of another length.
        """
        for name, column in self.columns().items():
            if name not in columns or columns[name].shape != column.shape:
                raise ValueError(f"running statistics: {name} must have shape {list(column.shape)}")
        self.count = columns["observation_count"].item()
        self.mean = columns["observation_mean"].to("cpu", torch.float64, copy=True).numpy()
        self.var = columns["observation_variance"].to("cpu", torch.float64, copy=True).numpy()


def _children(space: spaces.Space) -> dict[int | str, spaces.Space]:
    """Return the entries of a Tuple or Dict; none of another space."""
    children: dict[int | str, spaces.Space] = {}
    if isinstance(space, spaces.Tuple):
        children.update(enumerate(space.spaces))
    elif isinstance(space, spaces.Dict):
        children.update(space.spaces.items())
    return children


def _leaves(space: spaces.Space) -> Iterator[tuple[tuple[int | str, ...], spaces.Space]]:
    """Yield the spaces inside a space, in the order of its flattened vector, each with the entries that lead to it."""
    if not isinstance(space, spaces.Tuple | spaces.Dict):
        yield (), space
    for entry, child in _children(space).items():
        for path, leaf in _leaves(child):
            yield (entry, *path), leaf


def _check_entries(space: spaces.Space, entries: Sequence[int | str]) -> None:
    names = list(_children(space))
    if not names:
        raise ValueError(f"observation_keys={entries}: the observation {written(space)} has no entries; use null")
    wrong = [entry for entry in entries if entry not in names]
    if wrong or not entries or len(set(entries)) < len(entries):
        raise ValueError(f"observation_keys={entries}: must name different entries of {names}; null: all")


def _is_inside(leaf: spaces.Space, value: Any) -> bool:
    """Return whether a discrete value is one that can be made one-hot. A Box may be left: its bounds only scale."""
    if isinstance(leaf, spaces.Box):
        return True
    number = np.asarray(value)
    if number.dtype.kind not in "iub":
        return False
    if isinstance(leaf, spaces.Discrete):
        return number.size == 1 and bool(0 <= number.item() - leaf.start < leaf.n)
    return leaf.contains(number.astype(leaf.dtype))


def _written_path(path: tuple[int | str, ...]) -> str:
    return f"entry {'.'.join(map(str, path))}" if path else "value"


def _is_flat(space: spaces.Space) -> bool:
    """Return whether flattening the space gives a Box."""
    if isinstance(space, spaces.Tuple):
        return all(map(_is_flat, space.spaces))
    if isinstance(space, spaces.Dict):
        return all(map(_is_flat, space.spaces.values()))
    return isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary)
