"""How observations are scaled: by their bounds, by running statistics or not at all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from gymnasium.wrappers.utils import RunningMeanStd
from torch import Tensor

from hpamdp.env.errors import ProblemError
from hpamdp.env.gymnasium.observation_spaces import ObservationSpace
from hpamdp.env.gymnasium.options import Scaling
from hpamdp.messages import warn

# Bounds further apart than this count as none: some environments write 1e10 or the largest float.
_WIDEST = 1e6
# After so many observations, bounds more than 1,000 times as wide as what was seen are told.
_WATCHED = 1000
_WIDE = 1e3
_CLIP = 10.0
_LARGEST_REWARD = 1e30  # its square, and sums of many, are finite
_SMALLEST = 1e-6  # standard deviation that is not counted as 0


class ObservationScaling:
    """The scaling of the observations of one space.

    Args:
        space: the space.
        scaling: `bounds` maps entries with finite bounds at most a million apart to [-1, 1] and leaves the others as
            they are. `running` normalises to mean 0 and standard deviation 1 over all observations so far, and clips to
            [-10, 10]. `none` changes nothing.
        raw: entries that stay as they are, whatever the scaling; see `ObservationSpace.places`.

    Attributes:
        statistics: of all observations so far, with `running`; else None.
        is_unscaled: whether all observations stay as they are.

    Raises:
        ValueError: there is no such scaling or entry.
    """

    def __init__(self, space: ObservationSpace, scaling: Scaling, raw: Sequence[int | str] = ()) -> None:
        self.dim = space.dim
        self.statistics = RunningStatistics(self.dim) if scaling == "running" else None
        self._is_raw = space.places(raw) if raw else None
        self._is_frozen = False
        self._centre = np.zeros(self.dim)
        self._half_width = np.ones(self.dim)
        self._limit = np.full(self.dim, np.inf if self.statistics is None else _CLIP)
        self._space = space
        self._seen = np.full(self.dim, np.inf), np.full(self.dim, -np.inf)
        self._num_to_watch = _WATCHED if scaling == "bounds" else 0
        if scaling == "bounds":
            self._read_bounds(*space.bounds())
        is_identity = bool((self._centre == 0.0).all() and (self._half_width == 1.0).all())
        self.is_unscaled = self.statistics is None and is_identity

    def _read_bounds(self, low: np.ndarray, high: np.ndarray) -> None:
        has_both = np.isfinite(low) & np.isfinite(high)
        half_width = 0.5 * np.where(has_both, high, 0.0) - 0.5 * np.where(has_both, low, 0.0)
        is_bounded = (half_width > 0.0) & (half_width <= 0.5 * _WIDEST)
        self._centre = np.where(is_bounded, 0.5 * low + 0.5 * np.where(is_bounded, high, 0.0), 0.0)
        self._half_width = np.where(is_bounded, half_width, 1.0)

    def scaled(self, vectors: np.ndarray) -> np.ndarray:
        """Return new observations `[M, dim]` scaled, float32; with `running`, they update the statistics first."""
        if self.statistics is not None and not self._is_frozen:
            self.statistics.update(vectors)
        if self._num_to_watch > 0 and not self._is_frozen and len(vectors):
            self._watch(vectors)
        return self.rescaled(vectors)

    def _watch(self, vectors: np.ndarray) -> None:
        """Warn of the first entry whose bounds are so wide that it is scaled to a constant."""
        low, high = self._seen
        self._seen = low, high = np.minimum(low, vectors.min(0)), np.maximum(high, vectors.max(0))
        self._num_to_watch -= len(vectors)
        is_narrow = (high > low) & (_WIDE * (high - low) < 2.0 * self._half_width) & (self._half_width > 1.0)
        if self._is_raw is not None:
            is_narrow &= ~self._is_raw
        if self._num_to_watch <= 0 and is_narrow.any():
            place = int(is_narrow.argmax())
            warn(
                f"observation {self._space.name_of(place)}: seen from {low[place]:.6g} to {high[place]:.6g}, but "
                f"bounds {2.0 * self._half_width[place]:,.6g} apart scale it to a constant; use "
                "env.observation_scaling=running, or narrower bounds"
            )

    def rescaled(self, vectors: np.ndarray) -> np.ndarray:
        """Return observations `[M, dim]` scaled as by `scaled`, but without updating the statistics."""
        if self.is_unscaled:
            return vectors.astype(np.float32)
        centre, width, limit = self.linear_map()
        return ((vectors - centre) / width).clip(-limit, limit).astype(np.float32)

    def linear_map(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what `rescaled` does now: the centre, the width to divide by and the limit, float64 `[dim]` each."""
        centre, width, is_raw = self._centre, self._half_width, self._is_raw
        if self.statistics is not None:
            centre, width = self.statistics.mean, self.statistics.unit()
        if is_raw is None:
            return centre, width, self._limit
        return np.where(is_raw, 0.0, centre), np.where(is_raw, 1.0, width), np.where(is_raw, np.inf, self._limit)

    def share(self, other: ObservationScaling) -> None:
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


class RewardScaling:
    """Divides rewards by the running standard deviation of the discounted return, in training.

    Source: `gymnasium.wrappers.vector.NormalizeReward`.

    Differs from the source:
    - a return starts again at 0 with every episode, also after a time limit;
    - a deviation below 1e-6 counts as 1, and scaled rewards are clipped.

    Args:
        num: number of environments.
        gamma: discount of the return.
        clip: largest absolute value of a scaled reward.

    Attributes:
        statistics: of all discounted returns so far.
        totals: sums of the episodes' rewards before they were scaled, `[N]`.
        is_off: whether rewards stay as they are, as in evaluations.
    """

    def __init__(self, num: int, gamma: float, clip: float = _CLIP) -> None:
        self.statistics = RunningStatistics(1, "return")
        self.totals = np.zeros(num)
        self.is_off = False
        self._gamma = gamma
        self._clip = clip
        self._returns = np.zeros(num)

    def begin(self, is_reset: np.ndarray) -> None:
        """Begin the returns of these environments, bool `[N]`."""
        self._returns[is_reset] = self.totals[is_reset] = 0.0

    def scaled(self, rewards: np.ndarray, is_stepped: np.ndarray) -> np.ndarray:
        """Return the rewards `[N]` of a step scaled, after an update of the statistics.

        Args:
            rewards: 0 where no step was taken.
            is_stepped: which environments took a step, bool `[N]`.

        Raises:
            ProblemError: a reward is not finite, or so large that its square is not.
        """
        self.totals = self.totals + rewards
        if self.is_off:
            return rewards
        if not (np.abs(rewards) < _LARGEST_REWARD).all():
            worst = rewards[~(np.abs(rewards) < _LARGEST_REWARD)][0]
            raise ProblemError(f"step returned the reward {worst:g}, which reward_scaling cannot scale")
        if is_stepped.any():
            self._returns = np.where(is_stepped, self._gamma * self._returns + rewards, self._returns)
            self.statistics.update(self._returns[is_stepped, None])
        deviation = float(np.sqrt(self.statistics.var[0]))
        return (rewards / (deviation if deviation > _SMALLEST else 1.0)).clip(-self._clip, self._clip)


class RunningStatistics(RunningMeanStd):
    """Gymnasium's mean and variance of all vectors so far, float64 `[dim]`, that can be saved.

    Differs from the source: no prior observation of mean 0 and variance 1 is mixed in (`epsilon` is 0).

    Args:
        dim: length of the vectors.
        name: beginning of the columns' names.
    """

    def __init__(self, dim: int, name: str = "observation") -> None:
        self._name = name
        super().__init__(epsilon=0.0, shape=(dim,))
        self._new: RunningMeanStd | None = None  # as long as all vectors are new

    def update(self, x: np.ndarray) -> None:
        """Add vectors `[M, dim]`."""
        super().update(x)
        if self._new is not None:
            self._new.update(x)

    def take_new(self) -> dict[str, Tensor]:
        """Return the statistics of the vectors since the last call or `set_columns` alone, as `columns`."""
        taken = self._as_columns(self if self._new is None else self._new)
        self._begin_new()
        return taken

    def _begin_new(self) -> None:
        self._new = RunningMeanStd(epsilon=0.0, shape=self.mean.shape)

    def add(self, columns: Mapping[str, Tensor]) -> None:
        """Add vectors of another process, given what its `take_new` returned.

        Source: Chan, Golub and LeVeque 1983, *Algorithms for computing the sample variance*.
        """
        count, mean, variance = (columns[name].numpy() for name in self.columns())
        if count > 0.0:
            self.update_from_moments(mean, variance, count.item())

    def unit(self) -> np.ndarray:
        """Return the standard deviations, `[dim]`; 1 for constant entries."""
        deviation = np.sqrt(self.var)
        return np.where(deviation > _SMALLEST, deviation, 1.0)

    def columns(self) -> dict[str, Tensor]:
        """Return a copy of the statistics, for a checkpoint."""
        return self._as_columns(self)

    def _as_columns(self, statistics: RunningMeanStd) -> dict[str, Tensor]:
        return {
            f"{self._name}_count": torch.tensor(statistics.count, dtype=torch.float64),
            f"{self._name}_mean": torch.tensor(statistics.mean, dtype=torch.float64),
            f"{self._name}_variance": torch.tensor(statistics.var, dtype=torch.float64),
        }

    def set_columns(self, columns: Mapping[str, Tensor]) -> None:
        """Continue from saved `columns`.

        Raises:
            ValueError: they are of vectors of another length, or hold invalid numbers.
        """
        for name, column in self.columns().items():
            if name not in columns or columns[name].shape != column.shape:
                raise ValueError(f"running statistics: {name} must have shape {list(column.shape)}")
            is_mean = name == f"{self._name}_mean"
            if not (columns[name].isfinite() & (is_mean | (columns[name] >= 0.0))).all():
                raise ValueError(f"running statistics: {name} must be finite{'' if is_mean else ' and at least 0'}")
        self._begin_new()
        self.count = columns[f"{self._name}_count"].item()
        self.mean = columns[f"{self._name}_mean"].to("cpu", torch.float64, copy=True).numpy()
        self.var = columns[f"{self._name}_variance"].to("cpu", torch.float64, copy=True).numpy()
