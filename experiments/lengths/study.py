"""Compare options whose length the selector chooses with learned terminations and with a fixed length.

python experiments/lengths/study.py FOLDER...    gathers the runs of experiment=lengths/... in these folders into
                                                 results.csv, then tabulates
python experiments/lengths/study.py              tabulates the stored results.csv
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import torch

from experiments.study_tables import (
    Rows,
    Run,
    add_to_tables,
    gathered,
    interval_text,
    markdown_table,
    mean_of,
    read_csv,
)
from hpamdp.analysis.statistics import spread
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
RUN = ("env", "termination", "high", "low", "seed")
sys.path.insert(0, str(HERE.parent.parent / "examples" / "crossing"))
from crossing import Crossing, best_values, cell_of  # noqa: E402

GAMMA = 0.9  # of the score on Crossing, where all arrivals have the same reward
ENDS = {
    ("steps", "meta_critic"): "`steps`, 3 each",
    ("learned", "option_critic"): "`learned`",
    ("chosen", "meta_critic"): "`chosen`",
    ("chosen", "actor"): "`chosen`",
}
PROBLEMS = {"crossing": "Crossing", "rooms": "Rooms"}


def gather(runs: Sequence[Run]) -> Rows:
    """Return a row for each run."""
    rows: Rows = []
    for run in runs:
        summary, agent = run.summary, run.config["agent"]
        share = share_on_crossing(run) if summary["env"] == "crossing" else summary["score"] / summary["ceiling"]
        rows.append(
            {
                "env": summary["env"],
                "termination": agent["termination"],
                "high": summary["high"],
                "low": summary["low"],
                "seed": summary["seed"],
                "frames": summary["frames"],
                "share": round(share, 4),
                "success": round(summary["success"], 4),
                "steps": round(summary["steps"], 3),
                "changes": round(summary["option_changes"], 3),
                "length": round(summary.get("option_length", float("nan")), 3),
                "cpu_s": round(summary["cpu_s"], 1),
            }
        )
    return sorted(rows, key=lambda row: (row["env"], row["termination"], row["high"], row["seed"]))


def share_on_crossing(run: Run) -> float:
    """Return the mean discounted return of the run's last evaluation over the best one from the same places."""
    played = run.played()
    env = Crossing(len(played["score"]), start=run.config["env"]["start"])
    env.seed_evaluation(run.config["eval"]["seed"])
    env.reset()
    best = torch.tensor(best_values(GAMMA, 1))[cell_of(env.place)].mean().item()
    return float((played["success"] * GAMMA ** (played["steps"] - 1.0)).mean()) / best


def table(rows: Rows) -> str:
    """Return a line for each problem and each way to end options."""
    lines = []
    for (env, title), (ends, how) in product(PROBLEMS.items(), ENDS.items()):
        of_ends = [row for row in rows if (row["env"], row["termination"], row["high"]) == (env, *ends)]
        if not of_ends:
            continue
        shares = [100.0 * row["share"] for row in of_ends]
        interval = f"{interval_text(shares, '.1f')}%" if len(shares) > 2 else ""
        length = "" if ends[0] != "chosen" else spread([row["length"] for row in of_ends], 1)
        cells = [
            title,
            how,
            f"`{ends[1]}`",
            len(of_ends),
            f"{spread(shares, 1)}%",
            interval,
            f"{min(shares):.1f}%",
            f"{100.0 * mean_of(of_ends, 'success'):.1f}%",
            f"{mean_of(of_ends, 'steps'):.1f}",
            length,
            f"{mean_of(of_ends, 'cpu_s'):.0f} s",
        ]
        lines.append(cells)
    head = (
        "problem | `agent.termination` | `high` | seeds | of the best return | 95 % interval | worst seed "
        "| success | steps | length | CPU"
    )
    return markdown_table(head, lines)


def main(folders: Sequence[str]) -> None:
    """Gather the runs in the folders, if any are given, and tabulate."""
    if folders:
        add_to_tables(HERE, {"results": gathered(folders, gather, env=("crossing", "rooms"))}, RUN)
    print(table(read_csv(HERE / "results.csv")))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
