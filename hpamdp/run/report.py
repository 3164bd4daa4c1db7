"""Run `hpamdp report`, which compares finished runs by their means over seeds."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from hpamdp.analysis.seed_report import DEFAULT_METRIC, report_on
from hpamdp.config.errors import ConfigError
from hpamdp.messages import file_and_reason, say

_DESCRIPTION = """\
Compare runs by their means over seeds.

  hpamdp report multirun/mystudy                      the table that the sweep ended with
  hpamdp report outputs/a outputs/b --to comparison   several runs; also writes report.csv and report.png
  hpamdp report multirun/mystudy --metric eval/success
"""


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
