"""Read runs as text and numbers, and group them by all of their settings but the seed."""

from __future__ import annotations

import json
import math
import os
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hpamdp.complaints import as_json
from hpamdp.env.facts import NAMING_SETTINGS
from hpamdp.messages import one_line, warn
from hpamdp.metrics_file import EVALUATION, FRAMES, read_rows
from hpamdp.run_files import (
    CONFIG_NAME,
    DIVERGED_NAME,
    ERROR_NAME,
    METRICS_NAME,
    SUMMARY_NAME,
    TENSORBOARD_NAME,
    WANDB_NAME,
    flat_settings,
    is_config_of_run,
    saved_config,
    saved_summary,
)

FINISHED, UNFINISHED, FAILED = "finished", "unfinished", "failed"
_SEED, _CHOICE = "seed", "choices."
_TIMES = {"wall_s", "cpu_s", "eval_cpu_s", "compile_cpu_s"}
_EFFORT = {"frames", "eval_steps", "evaluated_frames", "kept_frames", "kept_score"} | _TIMES
_NO_METRICS = {"episodes", "finished", _SEED} | _EFFORT  # numbers of a summary
_LARGEST = 1e100  # of a number in a statistic or a figure, so that their arithmetic does not overflow
_LONGEST = 40  # letters of a value in a name


@dataclass(frozen=True)
class SeedRun:
    """A run, as far as a report needs it.

    Attributes:
        folder: the run's folder.
        state: `FINISHED`, `UNFINISHED` or `FAILED`.
        settings: its settings as JSON, by their dotted names.
        value: the metric at the end of the run; None if the run is not finished or has no finite value there.
        curve: the metric over training, rows of frames and value.
        summary: its `summary.json`; empty if the run wrote none.
        metrics: names of all its metrics.
    """

    folder: Path
    state: str
    settings: dict[str, str]
    value: float | None
    curve: np.ndarray
    summary: dict[str, Any]
    metrics: frozenset[str]

    @property
    def seed(self) -> str:
        """The run's seed as text."""
        return self.settings.get(_SEED, "null")

    def effort(self, name: str) -> float | None:
        """Return `frames`, `wall_s` or `cpu_s` of the summary, or None if it has no such number."""
        return finite(self.summary.get(name))

    def references(self, metric: str) -> dict[str, float]:
        """Return a metric of the references that have it, by their names."""
        references = self.summary.get("references")
        if not metric.startswith(EVALUATION) or not isinstance(references, Mapping):
            return {}
        values = {
            name: finite(figures.get(metric.removeprefix(EVALUATION)))
            for name, figures in references.items()
            if isinstance(figures, Mapping)
        }
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class Configuration:
    """Runs that differ only in their seeds.

    Attributes:
        settings: what distinguishes the configuration from the others of its report, by names of the command line.
        problem: the problem's settings as text; equal for configurations whose scores can be compared.
        runs: one run a seed.
    """

    settings: dict[str, str]
    problem: str
    runs: list[SeedRun]

    @property
    def name(self) -> str:
        """The settings as words of a command line."""
        return one_line(" ".join(f"{name}={value}" for name, value in self.settings.items())) or "all runs"

    @property
    def scored(self) -> list[SeedRun]:
        """The runs with a final value."""
        return [run for run in self.runs if run.value is not None]

    @property
    def values(self) -> list[float]:
        """The final values, one a seed."""
        return [run.value for run in self.runs if run.value is not None]

    def count(self, state: str) -> int:
        """Return the number of runs in a state."""
        return sum(run.state == state for run in self.runs)


def finite(value: object) -> float | None:
    """Return a value as a float if it is a number that statistics can use, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= _LARGEST:
        return None
    return float(value)


def read_runs(folders: Iterable[Path], metric: str) -> list[SeedRun]:
    """Return the runs in the folders, at any depth, and warn about each run that cannot be read.

    Args:
        folders: folders of runs, or folders that contain them. A run that is found twice counts once.
        metric: a column of `metrics.csv`. The final value is that of the last row. The final value of `eval/NAME` is
            `NAME` of the summary.
    """
    seen = set[str]()
    found = [
        path
        for folder in folders
        for path in sorted(run_folders(folder, seen, (CONFIG_NAME, SUMMARY_NAME)), key=_natural)
    ]
    return [run for path in found if (run := _read(path, metric)) is not None]


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Return a key that sorts folder 10 after folder 9."""
    parts = re.split(r"(\d+)", str(path))
    return [(len(part.lstrip("0")), 0, part) if i % 2 else (0, 1, part) for i, part in enumerate(parts)]


def _read(folder: Path, metric: str) -> SeedRun | None:
    summary, config = saved_summary(folder), saved_config(folder)
    if not summary and os.path.lexists(folder / SUMMARY_NAME):
        warn(f"{one_line(folder)}: {SUMMARY_NAME} is damaged, left out")
        return None
    if not config:
        warn(f"{one_line(folder)}: {CONFIG_NAME} is missing or damaged, left out")
        return None
    if not is_config_of_run(config):
        if summary:
            warn(f"{one_line(folder)}: is of another program, left out")
        return None
    fault = fault_of(summary, config)
    if fault is not None:
        warn(one_line(f"{folder}: {fault}, left out"))
        return None
    rows = read_rows(folder / METRICS_NAME)  # none in the folder of an evaluation
    points = np.array(sorted((row[FRAMES], row.get(metric, math.nan)) for row in rows if FRAMES in row)).reshape(-1, 2)
    if summary.get(FINISHED):
        state = FINISHED
    else:
        is_failed = any(os.path.lexists(folder / name) for name in (ERROR_NAME, DIVERGED_NAME))
        state = FAILED if is_failed else UNFINISHED
    value = _final(summary, points, metric) if state == FINISHED else None
    curve = points[(np.abs(points) <= _LARGEST).all(1)]
    measured = {f"{EVALUATION}{name}" for name in summary.keys() - _NO_METRICS if finite(summary[name]) is not None}
    settings = {name: json.dumps(value, default=str, skipkeys=True) for name, value in flat_settings(config).items()}
    return SeedRun(
        folder, state, settings, value, curve, summary, frozenset({*measured, *(name for row in rows for name in row)})
    )


def _final(summary: Mapping[str, Any], points: np.ndarray, metric: str) -> float | None:
    name = metric.removeprefix(EVALUATION)
    if name in summary:
        return finite(summary[name])
    return finite(float(points[-1, 1])) if len(points) and not metric.startswith(EVALUATION) else None


def configurations(runs: Sequence[SeedRun]) -> list[Configuration]:
    """Group runs that differ only in their seeds, in order of appearance.

    If two runs have the same settings and the same seed, only one of them counts, and a warning names the other.
    """
    per_seed = _derived_from_seed(runs)
    groups: dict[tuple[tuple[str, str], ...], list[SeedRun]] = defaultdict(list)
    for run in runs:
        groups[tuple(sorted((name, text) for name, text in run.settings.items() if name not in per_seed))].append(run)
    all_settings = [group[0].settings for group in groups.values()]
    names = _distinguishing(all_settings, per_seed)
    if not names:
        names = [name for name in (f"{_CHOICE}env", f"{_CHOICE}high", f"{_CHOICE}low") if name in all_settings[0]]
    return [
        Configuration(
            {name.removeprefix(_CHOICE): _shown(own[name]) for name in names if name in own},
            " ".join(f"{name}={text}" for name, text in sorted(own.items()) if _is_of_problem(name)),
            _one_a_seed(group),
        )
        for own, group in zip(all_settings, groups.values(), strict=True)
    ]


def _is_of_problem(name: str) -> bool:
    return name == f"{_CHOICE}env" or name.startswith("env.")


def _derived_from_seed(runs: Sequence[SeedRun]) -> set[str]:
    """Return the settings that equal the seed in every run, such as those given as `${seed}`."""
    if len({run.seed for run in runs}) < 2:
        return {_SEED}
    return {_SEED} | {name for name in runs[0].settings if all(run.settings.get(name) == run.seed for run in runs)}


def _distinguishing(all_settings: Sequence[Mapping[str, str]], left_out: set[str]) -> list[str]:
    """Return the names of the settings that distinguish the configurations.

    A choice, such as `low`, brings its own settings along. So other settings count only if they differ between
    configurations with the same choices. Of settings with the same values, such as those given as `${total_frames}`,
    the first one counts.
    """
    names = [name for name in dict.fromkeys(name for own in all_settings for name in own) if name not in left_out]
    choices = [name for name in names if name.startswith(_CHOICE)]
    classes: dict[tuple[str | None, ...], list[Mapping[str, str]]] = defaultdict(list)
    for own in all_settings:
        classes[tuple(own.get(name) for name in choices)].append(own)
    found: dict[tuple[str | None, ...], str] = {}
    for name in sorted(names, key=lambda name: (name not in choices, "." in name)):
        differs = any(len({own.get(name) for own in same}) > 1 for same in classes.values())
        if differs or (name in choices and len({own.get(name) for own in all_settings}) > 1):
            found.setdefault(tuple(own.get(name) for own in all_settings), name)
    return list(found.values())


def _shown(text: str) -> str:
    value = json.loads(text)
    line = one_line(value if isinstance(value, str) else text)
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 1]}…"


def _one_a_seed(runs: Sequence[SeedRun]) -> list[SeedRun]:
    """Return one run for each seed, or one evaluation for each agent; a finished one if there is one."""
    _warn_of_objects(runs)
    chosen: dict[str, SeedRun] = {}
    for run in sorted(runs, key=lambda run: run.state != FINISHED):
        is_evaluation = run.settings.get("mode") == json.dumps("eval")
        # All of these evaluations are of one agent, since `checkpoint` is among their settings.
        seed = "" if is_evaluation else run.seed
        if seed in chosen:
            same = "evaluates the agent" if is_evaluation else "has the settings and the seed"
            warn(one_line(f"{run.folder}: {same} of {chosen[seed].folder}, left out"))
        else:
            chosen[seed] = run
    return [run for run in runs if any(run is each for each in chosen.values())]


def _warn_of_objects(runs: Sequence[SeedRun]) -> None:
    """Warn if runs count as seeds of one configuration whose environments were objects from Python."""
    first = runs[0]
    names = [f"env.{name}" for name in NAMING_SETTINGS]
    is_object = all(first.settings.get(name) == "null" for name in names)
    if is_object and len(runs) > 1:
        warn(
            one_line(
                f"{first.folder} and {len(runs) - 1} more: their environments were objects from Python, which no "
                "config tells apart; they count as one environment"
            )
        )


def run_folders(folder: Path, seen: set[str], marks: Collection[str] = (SUMMARY_NAME,)) -> Iterator[Path]:
    """Yield the folders that hold a file with one of these names, and warn about broken links.

    Links to folders are followed, except to folders above. Folders whose names begin with a dot are left out.

    Args:
        folder: the folder to search.
        seen: real paths of folders that were searched before, and are left out. The searched folders are added.
        marks: the names.
    """

    def report(error: OSError) -> None:
        warn(one_line(f"{error.filename}: {error.strerror}, left out"))

    start = Path(os.path.realpath(folder))
    for path, folders, files in os.walk(folder, onerror=report, followlinks=True):
        real = os.path.realpath(path)
        is_above = real != str(start) and start.is_relative_to(real)
        if real in seen or is_above:  # by a link
            folders.clear()
            continue
        folders[:] = [name for name in folders if name not in (TENSORBOARD_NAME, WANDB_NAME) and name[0] != "."]
        seen.add(real)
        if not {*marks}.isdisjoint(files):
            yield Path(path)
        for name in files:
            if name not in marks and not os.path.exists(os.path.join(path, name)):
                warn(one_line(f"{os.path.join(path, name)}: is a broken link, left out"))


def fault_of(summary: Mapping[str, Any], config: Mapping[str, Any]) -> str | None:
    """Return why it is not known which seed a run has or whether it is finished; None if both are known.

    Args:
        summary: the run's `summary.json`; empty if there is none.
        config: its `config.yaml`.
    """
    if "seed" in config:
        seed = config["seed"]
        told = summary.get("seed", seed)
        if type(seed) is not int:
            return f"{CONFIG_NAME} has seed={as_json(seed)}, which is no whole number"
        if type(told) is not int or told != seed:
            return f"{CONFIG_NAME} has seed={seed}, but {SUMMARY_NAME} has seed={as_json(told)}"
    is_finished = summary.get("finished", False)
    if not isinstance(is_finished, bool):
        return f"{SUMMARY_NAME} has finished={as_json(is_finished)}, which is neither true nor false"
    return None
