"""Tabulate how far each library's learner comes on the keys.

python experiments/peers_small/study.py [FILE]...    gathers these files into results.csv, then tabulates it
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.study_tables import first_at, groups, markdown_table, read_csv, write_tables
from hpamdp.analysis.statistics import spread

HERE = Path(__file__).resolve().parent
STEPS = (1000, 3000, 7000, 16_000)
LEVEL, SECONDS = 0.9, 30.0


def cells(rows: list[dict]) -> list[str]:
    """Return a line of the table: the last score within each number of steps, and the first one of 0.9."""
    runs = list(groups(rows, "seed").values())
    line = [rows[0]["player"], str(len(runs))]
    for steps in STEPS:  # a batch may end a little later
        known = [[row["way"] for row in run if row["steps"] <= 1.05 * steps] for run in runs]
        reached = all(known) and all(run[-1]["steps"] >= 0.95 * steps for run in runs)
        line.append(spread([ways[-1] for ways in known], 2) if reached else "-")
    line.append(spread([[row["way"] for row in run if row["cpu_s"] <= SECONDS + 1.5][-1] for run in runs], 2))
    firsts = [first_at(run, "way", LEVEL) for run in runs]
    line.append(", ".join("none" if first is None else f"{first['steps']:,}" for first in firsts))
    return [*line, f"{np.mean([1000 * run[-1]['cpu_s'] / run[-1]['steps'] for run in runs]):.1f} s"]


def main(arguments: Sequence[str]) -> None:
    """Gather, tabulate."""
    if arguments:
        write_tables(HERE, {"results": [row for file in arguments for row in read_csv(Path(file))]})
    head = f"player | seeds | {' | '.join(f'{steps:,}' for steps in STEPS)} | {SECONDS:g} CPU s | steps to {LEVEL}"
    head += " | CPU of 1,000 steps"
    players = groups(read_csv(HERE / "results.csv"), "player")
    print(markdown_table(head, [cells(rows) for rows in players.values()]))


if __name__ == "__main__":
    main(sys.argv[1:])
