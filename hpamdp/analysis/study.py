"""What the runs of a study come to: their files gathered into tables, with the seeds as the unit of the statistics."""

from __future__ import annotations

import csv
import json
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, OmegaConf
from scipy import stats

from hpamdp.run.metrics import read_rows

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Run:
    """One finished run's folder, summary and config."""

    folder: Path
    summary: dict[str, Any]
    config: DictConfig

    def evaluations(self) -> list[dict[str, float]]:
        """Return the rows of its metrics that hold an evaluation."""
        return [row for row in read_rows(self.folder / "metrics.csv") if "eval/score" in row]

    def played(self) -> dict[str, np.ndarray]:
        """Return its final evaluation, one array an attribute, first dimension the episode."""
        with np.load(self.folder / "evaluation.npz") as file:
            return dict(file)


def finished(folders: Iterable[Path | str]) -> list[Run]:
    """Return the finished runs under the folders, in the order of their names; stopped ones are named on stderr."""
    runs = []
    for file in (file for folder in folders for file in sorted(Path(folder).glob("**/summary.json"))):
        summary = json.loads(file.read_text())
        if summary["finished"]:
            config = OmegaConf.load(file.parent / "config.yaml")
            assert isinstance(config, DictConfig)
            runs.append(Run(file.parent, summary, config))
        else:
            print(f"{file.parent}: was stopped, left out", file=sys.stderr)
    return runs


def write_tables(folder: Path, tables: Mapping[str, Rows]) -> None:
    """Write each table as a csv of its name, the first row's columns at the top; none of them, if one has no rows.

    Raises:
        SystemExit: with a line that names those without rows.
    """
    empty = [name for name, rows in tables.items() if not rows]
    if empty:
        files = ", ".join(f"{name}.csv" for name in empty)
        raise SystemExit(f"in the folders given are no finished runs for {files}; nothing was written")
    for name, rows in tables.items():
        with (folder / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)


def read_csv(path: Path) -> Rows:
    """Read rows from csv; numbers as such."""
    with path.open(newline="") as file:
        return [{name: _number(value) for name, value in row.items()} for row in csv.DictReader(file)]


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def groups(rows: Rows, *names: str) -> dict[tuple[Any, ...], Rows]:
    """Return the rows by their values of the named columns, in order of appearance."""
    found = defaultdict(list)
    for row in rows:
        found[tuple(row[name] for name in names)].append(row)
    return dict(found)


def spread(values: Sequence[float], digits: int = 3) -> str:
    """Return mean ± standard deviation over seeds, or the one value."""
    mean = f"{np.mean(values):.{digits}f}"
    return f"{mean} ± {np.std(values, ddof=1):.{digits}f}" if len(values) > 1 else mean


def interquartile_mean(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean of the middle half, and its 95 % percentile bootstrap interval over seeds.

    Source: Agarwal et al. 2021, arXiv 2108.13264, for one task.
    """
    sample = np.asarray(values, dtype=float)
    middle = float(stats.trim_mean(sample, 0.25))
    if len(sample) < 2 or np.ptp(sample) == 0.0:
        return middle, middle, middle
    interval = stats.bootstrap(
        (sample,), lambda x, axis: stats.trim_mean(x, 0.25, axis=axis), method="percentile", rng=0, n_resamples=2000
    ).confidence_interval
    return middle, float(interval.low), float(interval.high)


def curve(runs: Rows, x: str, y: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `x` and the mean and standard deviation over seeds of `y`, as far as all the seeds go."""
    seeds = [np.array([(row[x], row[y]) for row in rows], dtype=float) for rows in groups(runs, "seed").values()]
    num = min(map(len, seeds))
    heights = np.array([seed[:num, 1] for seed in seeds])
    return np.mean([seed[:num, 0] for seed in seeds], 0), heights.mean(0), heights.std(0)
