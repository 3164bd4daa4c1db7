"""Gather the runs of the learners' multirun into results.csv and curves.csv, and draw and tabulate them.

python experiments/learners/study.py multirun/learners     reads the runs, writes both csv files, then draws
python experiments/learners/study.py                       draws and tabulates the stored csv files
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from experiments.study_tables import (
    Rows,
    Run,
    add_to_tables,
    curve,
    difference,
    first_at,
    gathered,
    groups,
    markdown_table,
    mean_of,
    read_csv,
    with_enough_seeds,
)
from hpamdp.analysis.statistics import spread
from hpamdp.env.boatdock.reference import HUMAN
from hpamdp.figure_style import LEARNER_COLOURS
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
BOATS = ("congruent", "incongruent")
# Settings of the problem that may differ from its own; those with None tell rows apart.
OF_PROBLEM = {"boatdock.controller": None, "boatdock.reward": None}
COLOURS = {
    **LEARNER_COLOURS,
    "pdqn as MP-DQN": LEARNER_COLOURS["mpdqn_published"],
    "pdqn as P-DQN": LEARNER_COLOURS["pdqn_published"],
}
CURVE_COLUMNS = ("frames", "wall_s", "eval/score", "eval/success")


def gather(runs: Sequence[Run]) -> tuple[Rows, Rows]:
    """Return a row for each run and a row for each evaluation."""
    results: Rows = []
    curves: Rows = []
    for run in runs:
        summary = run.summary
        evaluations = run.evaluations()
        name = {
            "low": _name(run),
            "problem": summary.get("controller", summary["env"]),
            "reward": "sparse" if run.config["env"].get("reward") == "sparse" else "shaped",
            "seed": summary["seed"],
        }
        reached = first_at(evaluations, "eval/score", HUMAN["chosen"]["score"])
        results.append(
            {
                **name,
                "score": round(summary["score"], 4),
                "success": round(summary["success"], 4),
                "ceiling": round(summary["ceiling"], 4),
                "random": round(summary["references"]["random"]["score"], 4),
                "presses": summary["frames"],
                "wall_s": round(summary["wall_s"], 1),
                "cpu_s": round(summary["cpu_s"], 1),
                "presses_to_human": "" if reached is None else reached["frames"],
                "wall_s_to_human": "" if reached is None else reached["wall_s"],
            }
        )
        for row in evaluations:
            curves.append({**name, **{column: round(row[column], 4) for column in CURVE_COLUMNS}})
    return results, curves


def _name(run: Run) -> str:
    """Return the learner's name; P-DQN's published forms have separate names."""
    low = run.config["low"]
    if run.summary["low"] != "pdqn" or low["twin"]:
        return run.summary["low"]
    return "pdqn as MP-DQN" if low["multipass"] else "pdqn as P-DQN"


def table(results: Rows) -> str:
    """Return a line for each learner, problem and reward, Platform last: mean and standard deviation over seeds."""
    lines = []
    cases = groups(results, "low", "problem", "reward").items()
    for (low, problem, reward), runs in sorted(cases, key=_order):
        to_human = ["-", "-"]
        if all(run["presses_to_human"] for run in runs):
            to_human = [f"{mean_of(runs, 'presses_to_human'):,.0f}", f"{mean_of(runs, 'wall_s_to_human'):.0f} s"]
        cells = [low, problem, reward, len(runs), spread([run["score"] for run in runs])]
        cells += [f"{mean_of(runs, 'success'):.1%}", f"{mean_of(runs, 'presses'):,.0f}"]
        cells += [f"{mean_of(runs, 'wall_s'):.0f} s", f"{mean_of(runs, 'cpu_s'):.0f} s"]
        lines.append([*cells, *to_human])
    head = "learner | problem | reward | seeds | score | success | presses | wall | CPU | presses to 1.97 | after"
    return markdown_table(head, lines)


def boats_table(results: Rows) -> str:
    """Return a line with the difference of scores for each learner that was trained with both controllers."""
    lines = []
    for (low,), runs in groups(results, "low").items():
        scores = [
            [run["score"] for run in runs if (run["problem"], run["reward"]) == (boat, "shaped")] for boat in BOATS
        ]
        if all(scores):
            found = difference(*scores)
            lines.append([low, found, f"{found.improvement:.2f}"])
    return markdown_table("learner | congruent less incongruent (95 %) | probability of improvement", lines)


def _order(case: tuple[tuple[Any, ...], Rows]) -> tuple[bool, str]:
    """Return the place of a line: the boats before Platform, the shaped before the sparse reward."""
    (_, problem, reward), _ = case
    return problem not in BOATS, reward


def draw(curves: Rows, results: Rows, reward: str, x: str, path: Path) -> None:
    """Draw the learning curves of one reward by controller: mean over seeds and one standard deviation."""
    shown = [row for row in curves if row["reward"] == reward and row["problem"] in BOATS]
    boats = sorted({row["problem"] for row in shown})
    figure = Figure(figsize=(6.4 * len(boats), 4.2), layout="constrained")
    for axes, boat in zip(figure.subplots(1, len(boats), squeeze=False)[0], boats, strict=True):
        learners = groups([row for row in shown if row["problem"] == boat], "low")
        ends = [_draw_learner(axes, rows, low, x) for (low,), rows in learners.items() if low in COLOURS]
        _draw_references(axes, [row for row in results if row["problem"] == boat], boat)
        axes.legend(loc="lower right", fontsize=8, frameon=False)
        axes.set_xscale("log")
        axes.set_xlim(right=max(ends) * 1.1)
        axes.set_ylim(-1.3, 3.7)
        axes.set_title(f"{boat} boat, {reward} reward", loc="left", fontweight="bold", fontsize=10)
        axes.set_xlabel("presses" if x == "frames" else "seconds of training, evaluations included")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_ylabel("score, greedy, 1,000 layouts")
    with mpl.rc_context({"font.size": 9}):
        figure.savefig(path, dpi=130)


def _draw_learner(axes: Axes, rows: Rows, low: str, x: str) -> float:
    """Draw a learner's curve and return where it ends."""
    at, mean, deviation = curve(rows, x, "eval/score")
    late = at > 0  # the axis is logarithmic
    lower, upper = (mean - deviation)[late], (mean + deviation)[late]
    axes.plot(at[late], mean[late], color=COLOURS[low], linewidth=1.8, label=low)
    axes.fill_between(at[late], lower, upper, color=COLOURS[low], alpha=0.18, lw=0)
    return float(at[-1])


def _draw_references(axes: Axes, results: Rows, boat: str) -> None:
    references = {
        "ceiling": (mean_of(results, "ceiling"), "#2b2b2b", "-"),
        "people": (HUMAN[boat]["score"], "#D98200", "--"),
        "random": (mean_of(results, "random"), "#8c8c8c", ":"),
    }
    for name, (height, colour, style) in references.items():
        axes.axhline(height, color=colour, linestyle=style, linewidth=1.0, zorder=1)
        axes.annotate(f"{name} {height:.2f}", (0.005, height + 0.04), xycoords=("axes fraction", "data"), fontsize=8)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        results, curves = gathered(folders, gather, settings=OF_PROBLEM, env=("boatdock", "platform"), high=("none",))
        names = ("low", "problem", "reward", "seed")
        add_to_tables(HERE, {"results": results, "curves": curves}, names, steps="presses", sorts=False)
    stored = (read_csv(HERE / f"{name}.csv") for name in ("results", "curves"))
    results, curves = (with_enough_seeds(rows, "low", "problem", "reward") for rows in stored)
    draw(curves, results, "shaped", "frames", HERE / "curves.png")
    draw(curves, results, "sparse", "frames", HERE / "curves_sparse.png")
    draw(curves, results, "shaped", "wall_s", HERE / "curves_seconds.png")
    print(table(results), boats_table(results), sep="\n\n")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
