"""Gather and tabulate what each kind of exploration changes, for two learners on four problems.

python experiments/exploration/study.py FOLDER...    adds the finished runs in these folders to results.csv
python experiments/exploration/study.py              only tabulates results.csv
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.study_tables import (
    Rows,
    Run,
    add_to_tables,
    first_at,
    gathered,
    groups,
    markdown_table,
    mean_of,
    read_csv,
    with_enough_seeds,
)
from hpamdp.analysis.statistics import spread
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
RUN = ("problem", "learner", "exploration", "seed")
PROBLEMS = ("crossing", "office", "pinball", "platform")
# Settings of the problem that may differ from its own; those with None tell rows apart.
OF_PROBLEM = {
    "office.tiles": (20,),
    "office.chooses_goal": None,
    **{f"{problem}.grouping": (None, "default") for problem in PROBLEMS},
}
LEARNERS = ("hppo", "pdqn")
# A selector over options that last four steps is a kind of exploration, too; on Crossing every row has one.
OPTIONS = "options"
KINDS = ("none", "held", "counts", "novelty", OPTIONS)
# A problem counts as solved if at least this fraction of greedy episodes succeeds.
SOLVED = 0.9


def kind_of(run: Run) -> str:
    """Return how a run explored."""
    explored = run.config["choices"]["exploration"]
    if run.summary["high"] == "none" or run.summary["env"] == "crossing":
        return explored
    return OPTIONS if explored == "none" else f"{OPTIONS} and {explored}"


def gather(runs: Sequence[Run]) -> Rows:
    """Return a row for each run: its last greedy evaluation, and the steps before the first one that solves."""
    rows: Rows = []
    for run in runs:
        solved = first_at(run.evaluations(), "eval/success", SOLVED)
        rows.append(
            {
                "problem": run.summary["env"],
                "learner": run.summary["low"],
                "exploration": kind_of(run),
                "seed": run.summary["seed"],
                "frames": run.summary["frames"],
                "score": round(run.summary["score"], 4),
                "success": round(run.summary["success"], 4),
                "solved_after": int(solved["frames"]) if solved else "",
                "cpu_s": round(run.summary["cpu_s"], 1),
            }
        )
    return rows


def table(rows: Rows) -> str:
    """Return a line for each learner on each problem, with a column for each kind of exploration with enough seeds."""
    rows = with_enough_seeds(rows, "problem", "learner", "exploration")
    columns = dict.fromkeys([*KINDS, *(row["exploration"] for row in rows)])
    lines = []
    for (problem, learner, frames), of_pair in groups(rows, "problem", "learner", "frames").items():
        kinds = groups(of_pair, "exploration")
        cells = [cell(kinds[kind,]) if (kind,) in kinds else "" for kind in columns]
        lines.append([problem, learner, f"{frames:,}", *cells])
    return markdown_table(" | ".join(["problem", "learner", "steps", *columns]), lines)


def cell(rows: Rows) -> str:
    """Return score, success, when each seed first solved the problem, and CPU time."""
    scores = [row["score"] for row in rows]
    digits = 0 if max(map(abs, scores)) > 100.0 else 3
    firsts = [f"{row['solved_after'] / 1000:.0f}" if row["solved_after"] != "" else "never" for row in rows]
    success, seconds = 100.0 * mean_of(rows, "success"), mean_of(rows, "cpu_s")
    return f"{spread(scores, digits)}; {success:.0f} %; {', '.join(firsts)}; {seconds:.0f} s"


def main(folders: Sequence[str]) -> None:
    """Add the runs in the folders, if any are given, and tabulate."""
    if folders:
        add_to_tables(
            HERE, {"results": gathered(folders, gather, settings=OF_PROBLEM, env=PROBLEMS, low=LEARNERS)}, RUN
        )
    print(table(read_csv(HERE / "results.csv")))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
