"""Compare runs by their means over seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hpamdp.analysis.seed_report import DEFAULT_METRIC, report_on
from hpamdp.api.arguments import path_argument
from hpamdp.config.errors import ConfigError
from hpamdp.messages import as_code


def report(*folders: str | Path, metric: str = DEFAULT_METRIC, to: str | Path | None = None) -> list[dict[str, Any]]:
    """Return statistics over seeds of the runs in some folders, as `hpamdp report` prints them.

    Runs that differ only in their seeds are one configuration. Runs that are not finished count only as such.

    Args:
        folders: runs, or folders that contain runs at any depth, such as the folder of a sweep.
        metric: a column of the runs' `metrics.csv`. Of `eval/...` the final evaluation counts.
        to: folder for `report.csv` and `report.png`, created if it is missing. If None, nothing is written.

    Returns:
        A row for each configuration:
        - `configuration`: its name, made of the settings that distinguish it, and `settings`: the same as a dict;
        - `seeds`: number of finished runs with a finite value;
        - `mean`, `std` (of a sample), `min`, `max` of the metric;
        - `interval`: the bounds of the mean's 95 % interval (Student's t), from five seeds on;
        - `frames`, `cpu_s`: means over these runs;
        - `unfinished`, `failed`: numbers of other runs.

        A statistic is None if there are too few seeds for it.

    Raises:
        ConfigError: an argument is wrong, a folder does not exist or has no runs, or no run has the metric. Or `to`
            holds a file of one of these names that no report has written.
        OSError: a file cannot be written.

    Example:
        >>> import hpamdp
        >>> rows = hpamdp.report("multirun/mystudy")  # doctest: +SKIP
    """
    if not folders:
        raise ConfigError("report: name the folder of a run, or one that contains runs")
    if not isinstance(metric, str):
        raise ConfigError(f"metric={as_code(metric)}: must be the name of a column of metrics.csv")
    target = None if to is None else path_argument("to", to)
    if any(isinstance(folder, list | tuple) for folder in folders):
        raise ConfigError("report: folders in a list; give them one by one, such as report(*folders)")
    report = report_on([path_argument("folders", folder) for folder in folders], metric)
    if target is not None:
        report.write(target)
    return report.rows()
