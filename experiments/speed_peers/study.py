"""Tabulate the speed of PPO in several libraries.

python experiments/speed_peers/study.py [FILE]...    gathers these files of `queue.sh` into results.csv, then tabulates
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from experiments.study_tables import Rows, groups, markdown_table, read_csv, write_tables
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
PROBLEMS = {"cartpole": "CartPole", "boats": "boats"}


def cells(runs: Rows) -> list[str]:
    """Return a line of the table from the runs of one player on one problem."""
    first = runs[0]
    speeds = sorted(run["steps_per_s"] for run in runs)
    scores = {run["seed"]: f"{run['score']:.{2 if first['problem'] == 'boats' else 0}f}" for run in runs}
    start = median(run["import_s"] + run["compile_s"] for run in runs)
    return [
        PROBLEMS[first["problem"]],
        f"2 x {first['width']}, {first['epochs']} epochs",
        first["player"],
        f"{median(speeds):,.0f}",
        f"{speeds[0]:,} to {speeds[-1]:,}",
        f"{start:.1f} s",
        f"{median(run['peak_mib'] for run in runs):,.0f}",
        ", ".join(scores.values()),
        str(len(runs)),
    ]


def main(arguments: Sequence[str]) -> None:
    """Gather, tabulate."""
    if arguments:
        write_tables(HERE, {"results": [row for file in arguments for row in read_csv(Path(file))]})
    head = "problem | networks | player | steps a CPU second | of all repeats | imports and compiling | peak MiB"
    players = groups(read_csv(HERE / "results.csv"), "problem", "width", "epochs", "player")
    print(markdown_table(f"{head} | score of each run | repeats", [cells(runs) for runs in players.values()]))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
