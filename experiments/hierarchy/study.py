"""Gather the runs of the hierarchy's multirun into csv files, and draw and tabulate them.

python experiments/hierarchy/study.py FOLDER...    adds the runs in these folders to the csv files, in the place of
                                                   earlier ones of the same pair, length and seed; then draws and
                                                   tabulates. A cell of cells.csv shows the seeds of the protocol once
                                                   all of them have run, and until then the earlier ones.
python experiments/hierarchy/study.py              draws and tabulates the stored csv files
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from experiments.study_tables import (
    Rows,
    Run,
    add_to_tables,
    curve,
    difference,
    gathered,
    groups,
    markdown_table,
    mean_of,
    standing_rows,
    with_enough_seeds,
)
from hpamdp.analysis.statistics import spread
from hpamdp.env.boatdock.reference import HUMAN_CONGRUENT_BY_OFFSET, OFFSET_EDGES
from hpamdp.figure_style import draw_spread
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
TABLES = ("results", "curves", "choices")
CELL = ("low", "total", "uniform_option_steps", "high")
# Selectors with context, selectors without context, and references.
SELECTORS = {
    "meta_critic": "#0072B2",
    "linucb": "#009E73",
    "lin_thompson": "#56B4E9",
    "actor": "#CC79A7",
    "ucb": "#D55E00",
    "thompson": "#AA4499",
    "epsilon_greedy": "#882255",
    "exp3": "#999933",
    "uniform": "#8c8c8c",
    "human": "#D98200",
    "oracle": "#2b2b2b",
}
# Columns of results.csv, and their names in the summary.
COLUMNS = {
    "score": "score",
    "ceiling": "ceiling",
    "success": "success",
    "agreement": "oracle_agreement",
    "weighted_agreement": "oracle_agreement_weighted",
    "regret": "regret",
    "choice_gain": "choice_gain",
    "entropy": "choice_entropy",
    "score_congruent": "score_congruent",
    "score_incongruent": "score_incongruent",
    "wall_s": "wall_s",
    "cpu_s": "cpu_s",
}


def gather(runs: Sequence[Run]) -> tuple[Rows, Rows, Rows]:
    """Return a row for each run, for each evaluation, and for each run and bin of bearings."""
    results: Rows = []
    curves: Rows = []
    choices: Rows = []
    for run in runs:
        practice = run.config["agent"].get("practice", run.config["agent"].get("uniform_option_steps", 0))
        if not isinstance(practice, int):  # runs whose options practise by curves belong to ../whole_map
            continue
        name = {
            "high": run.summary["high"],
            "low": run.summary["low"],
            "total": run.config["total_frames"],
            "uniform_option_steps": practice,
            "seed": run.summary["seed"],
        }
        figures = {column: round(run.summary[key], 4) for column, key in COLUMNS.items()}
        results.append({**name, **figures})
        for row in run.evaluations():
            curves.append(
                {
                    **name,
                    "frames": row["frames"],
                    "score": round(row["eval/score"], 4),
                    "regret": round(row["eval/regret"], 4),
                    "oracle_agreement": round(row["eval/oracle_agreement"], 4),
                    "drift": round(_mean_drift(row), 4),
                }
            )
        played = run.played()
        bins = np.digitize(played["bearing_offset"], OFFSET_EDGES[1:-1])
        for number, offset in enumerate(OFFSET_EDGES[:-1]):
            share = float(played["option"][bins == number].mean())  # option 1 is the congruent controller
            choices.append({**name, "offset": offset, "congruent": round(share, 4)})
    return results, curves, choices


def _mean_drift(evaluation: dict[str, float]) -> float:
    """Return the mean absolute drift of the options, 0 if the evaluation has none."""
    drift = [abs(value) for column, value in evaluation.items() if column.startswith("eval/drift_")]
    return float(np.mean(drift)) if drift else 0.0


def table(results: Rows) -> str:
    """Return a line for each selector and learner: mean and standard deviation over seeds, the best first.

    Runs may have layouts of their own, so scores are compared by their distances to the ceiling of their layouts.
    """
    lines = []
    cases = sorted(groups(results, *CELL).items(), key=_order)
    for place, ((low, total, uniform, high), runs) in enumerate(cases, start=1):
        above = ""
        if place < len(cases) and cases[place][0][:3] == (low, total, uniform):
            above = str(difference(_below_ceiling(cases[place][1]), _below_ceiling(runs)))
        below, score = np.mean(_below_ceiling(runs)), spread([run["score"] for run in runs])
        cells = [high, low, f"{total:,.0f}, {uniform:,.0f}", len(runs), score, f"{below:.3f}", above]
        cells += [f"{mean_of(runs, column):.1%}" for column in ("agreement", "weighted_agreement")]
        cells += [f"{mean_of(runs, column):.3f}" for column in ("regret", "choice_gain")]
        lines.append([*cells, f"{mean_of(runs, 'success'):.1%}", f"{mean_of(runs, 'cpu_s'):.0f} s"])
    head = (
        "selector | learner | presses, uniform | n | score | below the ceiling | above the next (95 %) "
        "| oracle's | weighted | regret | gain | success | CPU"
    )
    return markdown_table(head, lines)


def _order(case: tuple[tuple[Any, ...], Rows]) -> tuple[Any, ...]:
    """Return the place of a line: by learner, length and uniform options, then the one closest to its ceiling first."""
    (low, total, uniform, _), runs = case
    return low, total, uniform, np.mean(_below_ceiling(runs))


def _below_ceiling(runs: Rows) -> list[float]:
    return [run["ceiling"] - run["score"] for run in runs]


def of_the_figures(rows: Rows) -> Rows:
    """Return the runs without uniform options, of the length that most selectors have over the learner."""
    plain = [row for row in rows if row["uniform_option_steps"] == 0]
    length = {}
    for (low,), of_learner in groups(plain, "low").items():
        selectors = {
            total: len(groups(of_length, "high")) for (total,), of_length in groups(of_learner, "total").items()
        }
        length[low] = max(selectors, key=lambda total: selectors[total])
    return [row for row in plain if row["total"] == length[row["low"]]]


def draw_curves(curves: Rows, column: str, label: str, path: Path) -> None:
    """Draw a column of the evaluations against presses, a panel for each learner: mean and deviation over seeds."""
    lows = list(dict.fromkeys(row["low"] for row in curves))
    figure = Figure(figsize=(6.2 * len(lows), 4.0), layout="constrained")
    for axes, low in zip(figure.subplots(1, len(lows), squeeze=False)[0], lows, strict=True):
        for high, colour in SELECTORS.items():
            rows = [row for row in curves if row["low"] == low and row["high"] == high]
            if not rows:
                continue
            draw_spread(axes, *curve(rows, "frames", column), color=colour, linewidth=1.5, label=high)
        _label(axes, low, "presses", label)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.legend(fontsize=7, frameon=False, ncols=2)
    figure.savefig(path, dpi=130)


def draw_choices(choices: Rows, path: Path) -> None:
    """Draw how often the congruent controller is chosen, by the bearing's offset, in a panel for each learner."""
    lows = list(dict.fromkeys(row["low"] for row in choices))
    middle = np.add(OFFSET_EDGES[:-1], OFFSET_EDGES[1:]) / 2
    figure = Figure(figsize=(6.2 * len(lows), 4.0), layout="constrained")
    for axes, low in zip(figure.subplots(1, len(lows), squeeze=False)[0], lows, strict=True):
        for high, colour in SELECTORS.items():
            rows = [row for row in choices if row["low"] == low and row["high"] == high]
            if not rows or high == "human":
                continue
            bins = groups(rows, "offset").values()
            shares = [np.mean([row["congruent"] for row in of_bin]) for of_bin in bins]
            axes.plot(middle, shares, color=colour, linewidth=1.5, label=high)
        axes.plot(middle, HUMAN_CONGRUENT_BY_OFFSET, "--", color=SELECTORS["human"], linewidth=2.2, label="people")
        _label(
            axes, low, "degrees from the congruent controller's nearest direction", "share of the congruent controller"
        )
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.legend(fontsize=7, frameon=False, ncols=2)
    figure.savefig(path, dpi=130)


def _label(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, loc="left", fontsize=10, fontweight="bold")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        new = dict(zip(TABLES, gathered(folders, gather, env=("boatdock",)), strict=True))
        add_to_tables(HERE, new, (*CELL, "seed"))
    stored = (standing_rows(HERE / f"{name}.csv") for name in TABLES)
    results, curves, choices = (with_enough_seeds(rows, *CELL) for rows in stored)
    curves, choices = of_the_figures(curves), of_the_figures(choices)
    print(table(results))
    draw_curves(curves, "regret", "regret of the greedy choice", HERE / "regret.png")
    draw_curves(curves, "score", "score, greedy, 1,000 layouts", HERE / "curves.png")
    draw_choices(choices, HERE / "choices.png")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
