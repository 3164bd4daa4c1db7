"""Run `hpamdp report`: a row of statistics for each configuration of runs, as a table and as files."""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from hpamdp.analysis.seed_curves import SOFTWARE, draw
from hpamdp.analysis.seed_runs import (
    FAILED,
    FINISHED,
    UNFINISHED,
    Configuration,
    SeedRun,
    configurations,
    read_runs,
)
from hpamdp.analysis.statistics import mean_interval, spread
from hpamdp.complaints import no_such
from hpamdp.config.errors import ConfigError
from hpamdp.files import regular_size, replacing
from hpamdp.messages import aligned, duration, file_and_reason, one_line, say
from hpamdp.metrics_file import EVALUATION

_DESCRIPTION = """\
Compare runs by their means over seeds.

  hpamdp report multirun/mystudy                      the table that the sweep ended with
  hpamdp report outputs/a outputs/b --to comparison   several runs; also writes report.csv and report.png
  hpamdp report multirun/mystudy --metric eval/success
"""
DEFAULT_METRIC = "eval/score"
TABLE_NAME, FIGURE_NAME = "report.csv", "report.png"
_BEGINNING = b"configuration,folder,seed,state,"  # of a table
_LEAST_FOR_INTERVAL = 5  # seeds
_MOST_NAMES, _LONGEST_NAME = 40, 60  # of the metrics that an error lists


@dataclass(frozen=True)
class Report:
    """Statistics of runs, with the seeds as the unit.

    Attributes:
        configurations: the groups of runs that differ only in their seeds.
        metric: a column of `metrics.csv`.
    """

    configurations: list[Configuration]
    metric: str

    @property
    def runs(self) -> list[SeedRun]:
        """All runs."""
        return [run for configuration in self.configurations for run in configuration.runs]

    def rows(self) -> list[dict[str, Any]]:
        """Return the statistics of each configuration; None where there are too few seeds for one."""
        return [_row(configuration) for configuration in self.configurations]

    def table(self) -> str:
        """Return a plain aligned table of the configurations, and below it what the reader should know of it."""
        title = one_line(self.metric.removeprefix(EVALUATION))
        rows = [_cells(configuration) for configuration in self.configurations]
        header = ["", "seeds", title, "min", "max", "95 % interval of the mean", "steps", "CPU time"]
        header += ["unfinished", "failed"]
        kept = [i for i in range(len(header)) if i < 3 or any(row[i] for row in rows)]
        lines = aligned([[row[i] for i in kept] for row in [header, *rows]])
        return "\n".join([*lines, *self._notes(title)])

    def _notes(self, title: str) -> list[str]:
        num_seeds = [len(each.values) for each in self.configurations]
        notes = []
        if max(num_seeds) > 1:
            alone = ", without a deviation if there is only one" if 1 in num_seeds else ""
            notes.append(f"{title}: mean ± standard deviation over seeds{alone}")
        elif 1 in num_seeds:
            notes.append(f"{title}: of one seed, so without a deviation; add seeds, such as seed=0,1,2")
        states = [
            f"{num} {state}"
            for state in (FAILED, UNFINISHED)
            if (num := sum(e.count(state) for e in self.configurations))
        ]
        if states:
            notes.append(f"{len(self.runs)} runs, of which {' and '.join(states)}; the table leaves these out")
        without = [run for run in self.runs if run.state == FINISHED and run.value is None]
        if without:
            notes.append(f"{len(without)} finished without a finite {title}, the first in {without[0].folder}")
        return notes

    def write(self, folder: Path) -> list[Path]:
        """Write a row for each run to `report.csv` and the learning curves to `report.png`, and return the files.

        If no finished run has the metric in its `metrics.csv`, there is no figure, and that of an earlier report is
        removed.

        Raises:
            ConfigError: a file of one of these names is there, and no report has written it. Then nothing is written.
            OSError: a file cannot be written.
        """
        table, figure = folder / TABLE_NAME, folder / FIGURE_NAME
        for path in (table, figure):
            if os.path.lexists(path) and not _is_of_a_report(path):
                raise ConfigError(f"{path}: no report has written this file, so it stays; move it away")
        folder.mkdir(parents=True, exist_ok=True)
        with (
            replacing(table) as partial,
            partial.open("w", encoding="utf-8", newline="") as file,
        ):
            rows = self._run_rows(folder)
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
        drawn = draw(self.configurations, self.metric)
        if drawn is None:
            figure.unlink(missing_ok=True)
            return [table]
        with replacing(figure) as partial:
            drawn(partial)
        return [table, figure]

    def _run_rows(self, folder: Path) -> list[dict[str, Any]]:
        return [
            {
                "configuration": each.name,
                "folder": one_line(os.path.relpath(run.folder, folder)),
                "seed": run.seed,
                "state": run.state,
                self.metric: run.value,
                **{name: run.effort(name) for name in ("frames", "wall_s", "cpu_s")},
            }
            for each in self.configurations
            for run in each.runs
        ]


def report_on(folders: Iterable[Path | str], metric: str = DEFAULT_METRIC) -> Report:
    """Return the report of all runs in the folders, at any depth.

    Raises:
        ConfigError: a folder does not exist, there is no run, or no finished run has the metric.
    """
    paths = [Path(folder) for folder in folders]
    for path in paths:
        if not os.path.isdir(path):
            is_file = os.path.exists(path)
            why = (
                "a file; give the folder of a run, or one that contains runs" if is_file else "there is no such folder"
            )
            raise ConfigError(f"{one_line(path)}: {why}")
    runs = read_runs(paths, metric)
    if not runs:
        raise ConfigError(f"{', '.join(one_line(path) for path in paths)}: no run in there")
    known = {name for run in runs for name in run.metrics}
    if metric not in known and any(run.state == FINISHED for run in runs):
        listed = sorted(one_line(name) for name in known if len(name) <= _LONGEST_NAME)[:_MOST_NAMES]
        raise ConfigError(f"metric={one_line(metric)}: {no_such('metric in these runs', metric, listed)}")
    return Report(configurations(runs), metric)


def _is_of_a_report(path: Path) -> bool:
    """Return whether a table or a figure was written by a report."""
    try:
        regular_size(path, follow_links=False)
        with path.open("rb") as file:
            beginning = file.read(1024)
    except OSError:
        return False
    return beginning.startswith(_BEGINNING) if path.name == TABLE_NAME else SOFTWARE.encode() in beginning


def _row(configuration: Configuration) -> dict[str, Any]:
    values, scored = configuration.values, configuration.scored
    low, high = mean_interval(values)
    interval = (low, high) if len(values) >= _LEAST_FOR_INTERVAL and not np.isnan(low) else None
    return {
        "configuration": configuration.name,
        "settings": dict(configuration.settings),
        "seeds": len(values),
        "mean": fmean(values) if values else None,
        "std": float(np.std(values, ddof=1)) if len(values) > 1 else None,
        "min": min(values, default=None),
        "max": max(values, default=None),
        "interval": interval,
        "frames": _mean_effort(scored, "frames"),
        "cpu_s": _mean_effort(scored, "cpu_s"),
        "unfinished": configuration.count(UNFINISHED),
        "failed": configuration.count(FAILED),
    }


def _mean_effort(runs: Sequence[SeedRun], name: str) -> float | None:
    known = [value for run in runs if (value := run.effort(name)) is not None]
    return fmean(known) if known else None


def _cells(configuration: Configuration) -> list[str]:
    row, values = _row(configuration), configuration.values
    several = len(values) > 1
    interval = row["interval"]
    return [
        configuration.name,
        str(row["seeds"]),
        spread(values) if values else "",
        f"{row['min']:.3f}" if several else "",
        f"{row['max']:.3f}" if several else "",
        f"{interval[0]:.3f} to {interval[1]:.3f}" if interval else "",
        "" if row["frames"] is None else f"{row['frames']:,.0f}",
        "" if row["cpu_s"] is None else duration(row["cpu_s"]),
        str(row["unfinished"] or ""),
        str(row["failed"] or ""),
    ]


def _path(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("must be a path, not an empty text")
    return Path(text)


def main(words: Sequence[str], parser: argparse.ArgumentParser) -> int:
    """Print the table, write the files if they are asked for, and return the exit code.

    Raises:
        ConfigError: a folder has no runs, no run has the metric, or a file cannot be written.
    """
    parser.description = _DESCRIPTION
    parser.add_argument("folders", nargs="+", type=_path, metavar="FOLDER", help="a run, or a folder of runs")
    parser.add_argument("--metric", default=DEFAULT_METRIC, help=f"a column of metrics.csv ({DEFAULT_METRIC})")
    parser.add_argument("--to", type=_path, metavar="FOLDER", help="where to write report.csv and report.png")
    options = parser.parse_intermixed_args(words)
    report = report_on(options.folders, options.metric)
    say(report.table())
    if options.to is not None:
        try:
            files = report.write(options.to)
        except OSError as error:
            raise ConfigError(f"--to {options.to}: {file_and_reason(error)}") from error
        say(f"Written: {', '.join(map(str, files))}")
    return 0
