"""Tabulate selectors over options: on other boats, on boats that may be changed, on Goal, Crossing and Rooms.

python experiments/options/study.py FOLDER...    adds the finished runs on Goal in these folders to goal.csv, then
                                                 tabulates
python experiments/options/study.py              tabulates the stored csv files

`train_boats.py`, `train_crossing.py` and `train_rooms.py` train, and add rows to the other files.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.study_tables import (
    FEWEST_SEEDS,
    FIRST_PROTOCOL_SEED,
    Rows,
    Run,
    add_to_tables,
    gathered,
    groups,
    interval_text,
    markdown_table,
    mean_of,
    read_csv,
    standing_rows,
)
from hpamdp.analysis.statistics import spread
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
DOMAINS = HERE.parent / "domains" / "results.csv"
ALONE = "none"
SELECTORS = ("meta_critic", "actor", "option_critic")
STEPS = 301_056  # of a run on Goal or Hard Goal
PAIR = ("low", "high")
SETTINGS = ("sharing", "termination", "option_length")  # columns of the runs on Rooms
BOATS = "env.boats="
CHANGED, KEPT = "changed for 0.1 s", "kept"


def gather(runs: Sequence[Run]) -> Rows:
    """Return a row for each run on Goal or Hard Goal."""
    return [
        {
            "domain": run.summary["env"],
            "low": run.summary["low"],
            "high": run.summary["high"],
            "frames": run.summary["frames"],
            "seed": run.summary["seed"],
            "success": round(run.summary["success"], 4),
            "cpu_s": round(run.summary["cpu_s"], 1),
        }
        for run in runs
    ]


def standing(rows: Rows, names: Sequence[str], settings: Sequence[str] = ()) -> dict[tuple[Any, ...], Rows]:
    """Return the cells with enough seeds: their runs with new seeds, or the earlier ones if there are too few of them.

    Rows on earlier seeds stay in the files.

    Args:
        rows: of a file.
        names: columns that name a cell.
        settings: columns in which the runs of a cell must agree.

    Raises:
        SystemExit: the runs of a cell have different settings, or a seed twice.
    """
    cells = {}
    for cell, of_cell in groups(rows, *names).items():
        new = [row for row in of_cell if row["seed"] >= FIRST_PROTOCOL_SEED]
        chosen = new if len(new) >= FEWEST_SEEDS else [row for row in of_cell if row["seed"] < FIRST_PROTOCOL_SEED]
        if len(chosen) >= FEWEST_SEEDS:
            cells[cell] = chosen
            if len(groups(chosen, *settings)) > 1:
                raise SystemExit(f"{', '.join(filter(None, cell))}: has runs with different {', '.join(settings)}")
            if len(groups(chosen, "seed")) < len(chosen):
                raise SystemExit(f"{', '.join(filter(None, cell))}: has two runs with the same seed")
    return cells


def boats() -> dict[tuple[str, str], Rows]:
    """Return the runs with more boats, by `BOATS` and selector, and the runs that change boats or keep them."""
    rows = read_csv(HERE / "boats.csv")
    for row in rows:
        words = row["words"].split()
        row["settings"] = " ".join(sorted(word for word in words if not word.startswith(("seed=", "eval.seed="))))
        selector = next(word.removeprefix("high=") for word in words if word.startswith("high="))
        changes = CHANGED if any(word.startswith("env.switch_cost=") for word in words) else KEPT
        is_of_boats = any(word.startswith(BOATS) for word in words)
        row["of_boats"], row["case"] = (BOATS, selector) if is_of_boats else ("", changes)
    return standing(rows, ("of_boats", "case"), ("settings",))


def on_goal() -> dict[tuple[str, str, str], Rows]:
    """Return the runs on Goal and Hard Goal by domain, learner and selector, those of `domains` without one."""
    runs = standing(read_csv(HERE / "goal.csv"), ("domain", *PAIR))
    alone = [
        {**row, "low": row["learner"], "high": ALONE}
        for row in standing_rows(DOMAINS)
        if (row["domain"], row["learner"]) in {(domain, low) for domain, low, _ in runs}
    ]
    return runs | groups(alone, "domain", *PAIR)


def by_pair(name: str) -> dict[tuple[str, str], Rows]:
    """Return the runs on Crossing or Rooms by learner and selector."""
    rows = read_csv(HERE / f"{name}.csv")
    return standing(rows, PAIR, [column for column in SETTINGS if column in rows[0]])


def boats_table(compares_changes: bool) -> str:
    """Return a line for each selector over three boats, or for agents that change boats and agents that keep them."""
    lines = []
    for (boats_word, name), rows in boats().items():
        if bool(boats_word) == compares_changes:
            continue
        changes = [row["option_changes"] for row in rows if row["option_changes"] != ""]
        cells = [
            name,
            len(rows),
            spread(_column(rows, "score")),
            f"{mean_of(rows, 'ceiling'):.3f}",
            _percent(rows, "share"),
            f"{np.mean(changes):.2f}" if changes else "0",
            _percent(rows, "oracle_agreement"),
            _percent(rows, "oracle_agreement_weighted"),
            _percent(rows, "success"),
            f"{mean_of(rows, 'frames'):,.0f}",
            f"{mean_of(rows, 'cpu_s'):.0f} s",
        ]
        lines.append(cells)
    head = (
        f"{'' if compares_changes else 'selector'} | seeds | score | ceiling | of the ceiling | changes per episode "
        "| planner's choice | weighted | success | presses | CPU"
    )
    return markdown_table(head, lines)


def goal_table() -> str:
    """Return a line for each selector on each domain, and for the learner without one."""
    lines = []
    for (domain, low, high), rows in sorted(on_goal().items(), key=lambda item: (item[0][:2], item[0][2] == ALONE)):
        scores = _column(rows, "success")
        cells = [domain.replace("_", " "), low, high, len(rows), spread(scores), interval_text(scores)]
        lines.append([*cells, f"{mean_of(rows, 'frames'):,.0f}", f"{mean_of(rows, 'cpu_s'):.0f} s"])
    return markdown_table("domain | learner | selector | seeds | goals | 95 % | steps | CPU", lines)


def pairs_table(name: str) -> str:
    """Return a line for each learner under each selector on Crossing or Rooms."""
    lines = []
    for (low, high), rows in by_pair(name).items():
        cells = [
            low,
            high,
            len(rows),
            f"{mean_of(rows, 'steps'):,.0f}",
            spread(_column(rows, "share")),
            f"{min(_column(rows, 'share')):.3f}",
            _percent(rows, "success"),
            _percent(rows, "value_error"),
            f"{mean_of(rows, 'cpu_s'):.0f} s",
        ]
        lines.append(cells)
    head = "learner | selector | seeds | steps | share | lowest seed | success | value error | CPU"
    return markdown_table(head, lines)


def _column(rows: Rows, name: str) -> list[float]:
    return [row[name] for row in rows]


def _percent(rows: Rows, name: str) -> str:
    return f"{100.0 * mean_of(rows, name):.1f}%"


def main(folders: Sequence[str]) -> None:
    """Add the runs on Goal, if folders are given, and tabulate."""
    if folders:
        of_study = {"env": ("goal", "hard_goal"), "high": SELECTORS, "frames": (STEPS,)}
        grouped = {f"{name}.grouping": ("default",) for name in of_study["env"]}
        new = gathered(folders, gather, settings=grouped, **of_study)
        add_to_tables(HERE, {"goal": new}, ("domain", *PAIR, "seed"))
    of_boats = (boats_table(compares_changes) for compares_changes in (False, True))
    print(*of_boats, goal_table(), *(pairs_table(name) for name in ("crossing", "rooms")), sep="\n\n")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
