"""Summarise values over seeds, which are the unit of the statistics."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats


def spread(values: Sequence[float], digits: int = 3) -> str:
    """Return a text: mean ± standard deviation (of a sample, n - 1) over seeds, or a single value."""
    mean = f"{np.mean(values):.{digits}f}"
    return f"{mean} ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else mean


def mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Return the bounds of Student's 95 % t interval of the mean over seeds; NaN with a single seed.

    They are also NaN if all values are the same, such as a success of 1: such seeds do not tell how far others may lie.
    The interval assumes that scores are normal over seeds. If one seed in five fails, the mean is less certain.
    """
    sample = np.asarray(values, dtype=float)
    if len(sample) < 2 or np.ptp(sample) == 0.0:
        return np.nan, np.nan
    half = float(stats.t.ppf(0.975, len(sample) - 1) * stats.sem(sample))
    return float(sample.mean()) - half, float(sample.mean()) + half


def mean_curve(curves: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return frames, and the mean, the standard deviation and the number of the curves there.

    A curve counts from its first to its last point, and is a straight line between two points. The standard deviation
    is that of a sample; it is 0 where only one curve counts.

    Args:
        curves: rows of frames and value, sorted by frames.
    """
    frames = np.unique(np.concatenate([curve[:, 0] for curve in curves]))
    heights = np.array([np.interp(frames, curve[:, 0], curve[:, 1], left=np.nan, right=np.nan) for curve in curves])
    counts = (~np.isnan(heights)).sum(0)
    frames, heights, counts = frames[counts > 0], heights[:, counts > 0], counts[counts > 0]
    means = np.nanmean(heights, 0)
    squares = np.nansum((heights - means) ** 2, 0)
    return frames, means, np.sqrt(squares / np.maximum(counts - 1, 1)), counts
