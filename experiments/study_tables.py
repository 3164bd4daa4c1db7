"""Gather the runs of a study into tables, with the seeds as the unit of the statistics."""

from __future__ import annotations

import csv
import math
import os
import warnings
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from scipy import stats

from hpamdp.analysis.seed_runs import fault_of, run_folders
from hpamdp.analysis.statistics import mean_curve, mean_interval
from hpamdp.config.compose import choosing, compose, plain_groups
from hpamdp.config.errors import MissingChoiceError
from hpamdp.files import replacing
from hpamdp.messages import file_and_reason, first_line, one_line, warn
from hpamdp.metrics_file import read_rows
from hpamdp.run_files import (
    CONFIG_NAME,
    ENV_WITHOUT_INFLUENCE,
    EVALUATION_NAME,
    METRICS_NAME,
    SUMMARY_NAME,
    are_same,
    saved_config,
    saved_summary,
)

Rows = list[dict[str, Any]]
T = TypeVar("T")

MIN_SEEDS = 10  # smallest number of seeds for an interquartile mean and a bootstrap interval
FEWEST_SEEDS = 3  # seeds that a cell needs for a place in a table
# Seeds from here on are those of the protocol: they run once, with settings that were frozen before. Runs with smaller
# seeds informed the settings.
FIRST_PROTOCOL_SEED = 100
PLAN_NAME = "cells.csv"  # beside a file of runs: the seeds that the protocol plans for each cell of a table


@dataclass(frozen=True)
class Run:
    """Folder, summary and config of a finished run."""

    folder: Path
    summary: dict[str, Any]
    config: dict[str, Any]

    def evaluations(self) -> list[dict[str, float]]:
        """Return the rows of the run's metrics that hold an evaluation."""
        return [row for row in read_rows(self.folder / METRICS_NAME) if "eval/score" in row]

    def played(self) -> dict[str, np.ndarray]:
        """Return the run's final evaluation as arrays whose first dimension is the episode."""
        with np.load(self.folder / EVALUATION_NAME, allow_pickle=False) as file:
            return dict(file)


def finished(folders: Iterable[Path | str]) -> list[Run]:
    """Return the finished runs under the folders, sorted by name, and warn about all other runs.

    Links to folders are followed. A run that is found twice counts once.

    Raises:
        SystemExit: a path is empty, which would stand for the working directory.
    """
    folders = [*folders]
    if "" in folders:
        raise SystemExit("an empty path; name the folders of the runs")
    runs, seen = [], set[str]()
    found: list[Path] = []
    for given in folders:
        is_new = os.path.realpath(given) not in seen
        of_given = sorted(run_folders(Path(given), seen))
        if is_new and not of_given and os.path.isdir(given):
            warn(f"{given}: has no runs")
        found += of_given
    for folder in found:
        summary, config = saved_summary(folder), saved_config(folder)
        if not summary or not config:
            warn(f"{folder}: {CONFIG_NAME if summary else SUMMARY_NAME} is missing or damaged, left out")
        elif fault := fault_of(summary, config):
            warn(one_line(f"{folder}: {fault}, left out"))
        elif summary.get("finished"):
            runs.append(Run(folder, summary, config))
        else:
            warn(f"{folder}: was stopped, left out")
    return runs


def gathered(
    folders: Iterable[Path | str],
    gather: Callable[[Sequence[Run]], T],
    *,
    settings: Mapping[str, Collection[Any] | None] = MappingProxyType({}),
    modes: Collection[str] = ("train",),
    **of_study: Collection[Any],
) -> T:
    """Return what a study's `gather` reads from its finished runs under the folders, and warn about all other runs.

    A run is left out if it is damaged, belongs to another study, or was made with other settings of its problem.

    Args:
        folders: the folders.
        gather: reads runs.
        settings: the values that the study's runs may have instead of the problem's own, such as
            `{"office.tiles": (20,), "hard_move.n": None}`. With None, any value.
        modes: what the runs may have as `mode`.
        of_study: what the summaries of the study's runs may have, by name, such as `env=("goal", "hard_goal")`.

    Raises:
        SystemExit: no run is left.
    """
    kept = []
    for run in finished(folders):
        fault = (
            _fault_in_summary(run, of_study)
            or _fault_in_mode(run, modes)
            or _fault_in_files(run, gather)
            or _fault_in_problem(run, settings)
        )
        if fault is None:
            kept.append(run)
        else:
            warn(one_line(f"{run.folder}: {fault}; left out"))
    if not kept:
        raise SystemExit("the given folders have no finished runs of this study; nothing was written")
    return gather(kept)


def _fault_in_summary(run: Run, of_study: Mapping[str, Collection[Any]]) -> str | None:
    """Return why a run does not belong to a study, or None."""
    for name, allowed in of_study.items():
        if run.summary.get(name) not in [*allowed]:
            return _not_of_study(name, run.summary.get(name), allowed)
    for name in ("seed", "frames"):
        if type(run.summary.get(name)) is not int:
            return f"{name}={run.summary.get(name)}: must be a whole number"
    for name in ("score", "success"):
        value = run.summary.get(name)
        if isinstance(value, float) and not math.isfinite(value):
            return f"{name}={value}: must be a finite number"
    return None


def _not_of_study(name: str, value: Any, allowed: Iterable[Any]) -> str:
    return f"{name}={value}, but runs of this study have {' or '.join(map(str, allowed))}"


def _fault_in_mode(run: Run, modes: Collection[str]) -> str | None:
    """Return why a run's mode is not one of these, or None. A config without a mode counts as training."""
    mode = run.config.get("mode", "train")
    return None if mode in [*modes] else _not_of_study("mode", mode, modes)


def _fault_in_files(run: Run, gather: Callable[[Sequence[Run]], object]) -> str | None:
    """Return why a study cannot read a run, or None."""
    try:
        if run.config.get("mode") != "eval":  # which writes no metrics
            evaluations, ended = run.evaluations(), run.summary["frames"]
            if not evaluations:
                return "metrics.csv is missing or has no evaluations"
            last = evaluations[-1].get("frames", math.nan)
            if last != ended:
                return f"metrics.csv has its last evaluation at {last:,.0f} frames, but the run ended at {ended:,}"
        gather([run])
    except KeyError as error:
        return f"has no {error.args[0]}, as runs of this study have"
    except OSError as error:
        return file_and_reason(error)
    except Exception as error:  # such as a text for a number in a damaged file
        return f"cannot be read by this study: {type(error).__name__}: {first_line(error)}"
    return None


def _fault_in_problem(run: Run, settings: Mapping[str, Collection[Any] | None]) -> str | None:
    """Return a setting of the run's problem that differs from those of the study's runs, or None.

    Only settings in the saved config are compared: earlier versions had fewer.
    """
    name, saved = str(run.summary["env"]), run.config.get("env")
    if not isinstance(saved, Mapping):
        return "config.yaml has no settings of the problem"
    own = _own_settings(name, str(run.summary.get("low")))
    for setting, value in saved.items():
        if setting in ENV_WITHOUT_INFLUENCE or setting not in own:
            continue
        allowed = settings.get(f"{name}.{setting}", (own[setting],))
        if allowed is not None and not any(are_same(value, each) for each in allowed):
            return _not_of_study(f"env.{setting}", value, allowed)
    return None


@cache
def _own_settings(env: str, low: str) -> dict[str, Any]:
    """Return a problem's settings as its yaml file and the recipe with the learner set them.

    They are empty for a problem whose yaml file is not in conf/.
    """
    for words in ([choosing("env", env), choosing("low", low)], [choosing("env", env)]):
        with suppress(MissingChoiceError):
            return plain_groups(compose(words), {}, ["env"])["env"]
    return {}


def write_tables(folder: Path, tables: Mapping[str, Rows]) -> None:
    """Write each table to a csv file of its name.

    Raises:
        SystemExit: a table has no rows. Then nothing is written.
    """
    empty = [name for name, rows in tables.items() if not rows]
    if empty:
        files = ", ".join(f"{name}.csv" for name in empty)
        raise SystemExit(f"the given folders have no finished runs for {files}; nothing was written")
    for name, rows in tables.items():
        with replacing(folder / f"{name}.csv") as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)


def read_csv(path: Path) -> Rows:
    """Read rows from a csv file, with whole numbers as ints and other numbers as floats.

    Raises:
        SystemExit: a row has more or fewer cells than the file has columns.
    """
    rows = []
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        for row in reader:
            if None in row or None in row.values():
                raise SystemExit(f"{path}: line {reader.line_num} has not as many cells as the first line")
            rows.append({name: _number(value) for name, value in row.items()})
    return rows


def _number(text: str) -> float | str:
    if "_" in text:  # Python would read 64_64 as 6464
        return text
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            pass
    return text


def groups(rows: Rows, *names: str) -> dict[tuple[Any, ...], Rows]:
    """Return the rows by their values in the named columns, in order of appearance."""
    found = defaultdict(list)
    for row in rows:
        found[tuple(row[name] for name in names)].append(row)
    return dict(found)


def planned_seeds(path: Path) -> dict[tuple[Any, ...], range]:
    """Return the seeds of a plan by cell. A row says `100-109` or `100`; the columns before `seeds` name its cell."""
    names, planned = _cell_columns(path), {}
    for cell in read_csv(path):
        first, _, last = str(cell["seeds"]).partition("-")
        planned[tuple(cell[name] for name in names)] = range(int(first), int(last or first) + 1)
    return planned


def _cell_columns(plan: Path) -> list[str]:
    with plan.open(newline="") as file:
        columns = next(csv.reader(file))
    return columns[: columns.index("seeds")]


def standing_rows(path: Path) -> Rows:
    """Read the rows of a csv file that stand in tables.

    A plan beside the file, `PLAN_NAME`, names the seeds of the protocol. The rows of a cell are those of the
    planned seeds once all are in the file, and until then those of the earlier seeds. Without a plan, or without the
    plan's columns, all rows stand.
    """
    rows, plan = read_csv(path), path.with_name(PLAN_NAME)
    names = _cell_columns(plan) if plan.exists() else []
    if not names or not rows or not {*names, "seed"} <= rows[0].keys():
        return rows
    planned = planned_seeds(plan)
    standing: Rows = []
    for cell, of_cell in groups(rows, *names).items():
        wanted, ran = planned.get(cell, range(0)), {row["seed"] for row in of_cell}
        if len(wanted) > 0 and ran.issuperset(wanted):
            standing += [row for row in of_cell if row["seed"] in wanted]
        else:
            standing += [row for row in of_cell if row["seed"] < FIRST_PROTOCOL_SEED]
            if len(wanted) == 0 and max(ran) >= FIRST_PROTOCOL_SEED:
                warn(f"{path.name}: {', '.join(map(str, cell))} has new seeds, but is not in {plan.name}; left out")
    return standing


def with_enough_seeds(rows: Rows, *names: str) -> Rows:
    """Return the rows of the cells, told apart by these columns, that have at least `FEWEST_SEEDS` seeds."""
    cells = groups(rows, *names).values()
    return [row for cell in cells if len({row["seed"] for row in cell}) >= FEWEST_SEEDS for row in cell]


def with_repeats_replaced(stored: Rows, new: Rows, names: Sequence[str]) -> Rows:
    """Return the stored rows that no new row repeats, told apart by these columns, and then the new rows."""
    made_anew = {_name_of(row, names) for row in new}
    return [row for row in stored if _name_of(row, names) not in made_anew] + new


def _name_of(row: Mapping[str, Any], names: Sequence[str]) -> tuple[str, ...]:
    return tuple(str(row[name]) for name in names)


def add_to_tables(folder: Path, tables: Mapping[str, Rows], names: Sequence[str], **how: Any) -> None:
    """Add rows to csv files, in the place of those of the runs that they repeat.

    Args:
        folder, tables, names, how: the arguments of `merged_tables`.

    Raises:
        SystemExit: `merged_tables` refuses a row. Then nothing is written.
    """
    write_tables(folder, merged_tables(folder, tables, names, **how))


def merged_tables(
    folder: Path,
    tables: Mapping[str, Rows],
    names: Sequence[str],
    *,
    steps: str = "frames",
    of_evaluations: bool = False,
    lengths_differ: bool = False,
    sorts: bool = True,
) -> dict[str, Rows]:
    """Check new rows, and return the rows of csv files with them. They replace those of the runs that they repeat.

    Args:
        folder: of the files.
        tables: the new rows by the names of the files. The first table has one row for each run.
        names: the columns that name a run.
        steps: the first table's column with the steps of a run. Without it, lengths are not compared.
        of_evaluations: whether the first table has a row for each evaluation instead, in order. `steps` is then its
            column with the steps before the evaluation.
        lengths_differ: whether the seeds of a cell may have different steps. Else a shorter run, such as a trial, is
            refused, which would join the cell's mean.
        sorts: whether to sort the rows by `names`, numbers before texts. Else stored rows stay in their order, and the
            new ones follow.

    Raises:
        SystemExit: the first table has no new rows, or has a run twice. Or the steps of a run differ from those of the
            run that it repeats, or of the other runs of its cell.
    """
    first, *_ = tables
    if not tables[first]:
        raise SystemExit("the given folders have no finished runs; nothing was written")
    refuse_repeats(tables[first], (*names, steps) if of_evaluations else names, names)
    stored = {table: read_csv(folder / f"{table}.csv") for table in tables}
    steps_of = {_name_of(row, names): row.get(steps) for row in _ends(stored[first], names)}
    new_runs = _ends(tables[first], names)
    for row in new_runs:
        run = _name_of(row, names)
        of_new, before = row.get(steps), steps_of.get(run)
        if before is not None and of_new != before:
            raise SystemExit(
                f"{', '.join(run)}: the given run has {of_new:,} steps and the one in {first}.csv {before:,}; nothing "
                "was written. Delete its rows to replace it"
            )
    if not lengths_differ:
        _refuse_other_lengths(with_repeats_replaced(_ends(stored[first], names), new_runs, names), names, steps)
    merged = {}
    for table, new in tables.items():
        rows = with_repeats_replaced(stored[table], new, names)
        if sorts:
            rows.sort(key=lambda row: [(isinstance(row[name], str), row[name]) for name in names])
        merged[table] = rows
    return merged


def refuse_repeats(rows: Rows, row_names: Sequence[str], run_names: Sequence[str]) -> None:
    """Refuse rows of which two have the same name.

    Args:
        rows: the rows.
        row_names: the columns that name a row.
        run_names: the columns that name its run.

    Raises:
        SystemExit: there are two.
    """
    twice = next((same[0] for same in groups(rows, *row_names).values() if len(same) > 1), None)
    if twice is not None:
        run = ", ".join(_name_of(twice, run_names))
        raise SystemExit(f"the given folders have two runs of {run}; nothing was written")


def _ends(rows: Rows, names: Sequence[str]) -> Rows:
    """Return the last row of each run."""
    return [of_run[-1] for of_run in groups(rows, *names).values()]


def _refuse_other_lengths(rows: Rows, names: Sequence[str], steps: str) -> None:
    """Refuse cells whose seeds have different steps.

    Raises:
        SystemExit: there is one.
    """
    for cell, of_cell in groups(rows, *(name for name in names if name != "seed")).items():
        lengths = sorted({row[steps] for row in of_cell if row.get(steps) is not None})
        if len(lengths) > 1:
            listed = " and ".join(f"{length:,}" for length in lengths)
            raise SystemExit(f"{', '.join(map(str, cell))}: has runs of {listed} steps; nothing was written")


def first_at(rows: Rows, column: str, level: float) -> dict[str, Any] | None:
    """Return the first row whose column is at least `level`, or None. A row may be an evaluation of a run."""
    return next((row for row in rows if row[column] >= level), None)


def mean_of(rows: Rows, column: str) -> float:
    """Return the mean of a column."""
    return float(np.mean([row[column] for row in rows]))


def markdown_table(head: str, rows: Iterable[Iterable[object]]) -> str:
    """Return a table in Markdown.

    Args:
        head: names of the columns, separated by `|`.
        rows: the cells of each line.
    """
    lines = [f"| {' | '.join(map(str, cells))} |" for cells in rows]
    return "\n".join([f"| {head} |", "|---" * (head.count("|") + 1) + "|", *lines])


def interquartile_mean(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean of the middle half, and the bounds of its 95 % expanded percentile bootstrap interval over seeds.

    The plain percentile interval of a few seeds is too narrow. The expanded interval is as wide as Student's t
    interval, within the sample's range. With fewer than `MIN_SEEDS` values it is too narrow, too, so `middle_half`
    omits mean and interval. The bounds are NaN if the values do not vary, as in `mean_interval`.

    Sources: Agarwal et al. 2021, arXiv 2108.13264, for one task; Hesterberg 2015, *What teachers should know about the
    bootstrap*, arXiv 1411.5279.
    """
    sample = np.asarray(values, dtype=float)
    middle = float(stats.trim_mean(sample, 0.25))
    if len(sample) < 2 or np.ptp(sample) == 0.0:
        return middle, np.nan, np.nan
    tail = stats.norm.cdf(stats.t.ppf(0.025, len(sample) - 1) * np.sqrt(len(sample) / (len(sample) - 1)))
    interval = stats.bootstrap(
        (sample,),
        lambda x, axis: stats.trim_mean(x, 0.25, axis=axis),
        confidence_level=1.0 - 2.0 * tail,
        method="percentile",
        rng=0,
        n_resamples=9999,
    ).confidence_interval
    return middle, float(interval.low), float(interval.high)


def middle_half(values: Sequence[float]) -> str:
    """Return a text with the interquartile mean and its interval. It is empty with fewer than `MIN_SEEDS` seeds."""
    if len(values) < MIN_SEEDS:
        return ""
    middle, low, high = interquartile_mean(values)
    return f"{middle:.3f}" if np.isnan(low) else f"{middle:.3f} ({low:.3f} to {high:.3f})"


def interval_text(values: Sequence[float], style: str = ".3f") -> str:
    """Return a text with the bounds of `mean_interval`, in a format such as `.3f`. It is empty if they are NaN."""
    low, high = mean_interval(values)
    return "" if np.isnan(low) else f"{low:{style}} to {high:{style}}"


@dataclass(frozen=True)
class Difference:
    """Difference of two methods' scores, with the seeds as the unit.

    Attributes:
        mean: difference of the means.
        low, high: Welch's 95 % t interval of the difference; NaN if either method has a single seed, or if the scores
            of neither vary.
        improvement: probability that a seed of the first method exceeds a seed of the second. Ties count half.
    """

    mean: float
    low: float
    high: float
    improvement: float

    @property
    def is_clear(self) -> bool:
        """Whether the interval excludes 0."""
        return self.low > 0.0 or self.high < 0.0

    def __str__(self) -> str:
        """Return the difference and its interval, with `unclear` if the interval contains 0."""
        if np.isnan(self.low):
            return f"{self.mean:+.3f}"
        interval = f"{self.mean:+.3f} ({self.low:+.3f} to {self.high:+.3f})"
        return interval if self.is_clear else f"{interval}, unclear"


def difference(values: Sequence[float], others: Sequence[float]) -> Difference:
    """Return the difference of the first scores and the others, one score per seed.

    It compares means, whatever the number of seeds, because interquartile means hide seeds that failed.

    Source of the probability: Agarwal et al. 2021, arXiv 2108.13264, for one task.
    """
    sample, other = np.asarray(values, dtype=float), np.asarray(others, dtype=float)
    pairs = np.sign(sample[:, None] - other[None, :])
    improvement = float((0.5 * (pairs + 1.0)).mean())
    mean = float(sample.mean() - other.mean())
    if min(len(sample), len(other)) < 2 or np.ptp(sample) == np.ptp(other) == 0.0:
        return Difference(mean, np.nan, np.nan, improvement)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # scores of one of them that do not vary
        bounds = stats.ttest_ind(sample, other, equal_var=False).confidence_interval()
    return Difference(mean, float(bounds.low), float(bounds.high), improvement)


def curve(runs: Rows, x: str, y: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return `x`, and the mean and the standard deviation of `y` over seeds, where every run has values.

    Between two values of a run the line is straight. The standard deviation is that of a sample, as in `spread`. With
    one seed it is 0.
    """
    seeds = [np.array(sorted((row[x], row[y]) for row in rows), dtype=float) for rows in groups(runs, "seed").values()]
    at, means, deviations, counts = mean_curve(seeds)
    is_whole = counts == len(seeds)
    return at[is_whole], means[is_whole], deviations[is_whole]
