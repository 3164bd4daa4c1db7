"""Gather the runs of the learners' multirun into results.csv and curves.csv, and draw and tabulate them.

python experiments/learners/study.py multirun/learners     reads the runs, writes both csv files, then draws
python experiments/learners/study.py                       draws and tabulates what the csv files hold
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from hpamdp.analysis.study import Rows, Run, curve, finished, groups, read_csv, spread, write_tables
from hpamdp.env.boatdock.reference import HUMAN

HERE = Path(__file__).resolve().parent
BOATS = ("congruent", "incongruent")
_REWARDS = {"given": "the paper's", "sparse": "sparse"}
COLOURS = {
    "hppo": "#0072B2",
    "hsac": "#D55E00",
    "pdqn": "#009E73",
    "hyar": "#CC79A7",
    "qpamdp": "#E69F00",
    "dlpa": "#56B4E9",
    "pdqn as MP-DQN": "#6b6b00",
    "pdqn as P-DQN": "#332288",
}


def gather(runs: Sequence[Run]) -> tuple[Rows, Rows]:
    """Return a row a run and a row an evaluation."""
    results, curves = [], []
    for run in runs:
        summary = run.summary
        name = {"low": _name(run), "problem": summary.get("controller", summary.get("env"))}
        is_sparse = run.config.env.get("reward") == "sparse"
        name |= {"reward": "sparse" if is_sparse else "given", "seed": summary["seed"]}
        rows = run.evaluations()
        reached = next((row for row in rows if row["eval/score"] >= HUMAN["chosen"]["score"]), {})
        results.append(
            name
            | {key: round(summary[key], 4) for key in ("score", "success", "ceiling")}
            | {"random": round(summary["references"]["random"]["score"], 4)}
            | {"presses": summary["frames"], "wall_s": round(summary["wall_s"], 1), "cpu_s": round(summary["cpu_s"], 1)}
            | {"presses_to_people": reached.get("frames", ""), "wall_s_to_people": reached.get("wall_s", "")}
        )
        columns = ("frames", "wall_s", "eval/score", "eval/success")
        curves += [name | {key: round(row[key], 4) for key in columns} for row in rows]
    return results, curves


def _name(run: Run) -> str:
    """Return the learner's name; P-DQN's published forms have names of their own."""
    low = run.config.low
    if run.summary["low"] != "pdqn" or low.twin_q:
        return run.summary["low"]
    return "pdqn as MP-DQN" if low.multipass else "pdqn as P-DQN"


def table(results: Rows) -> str:
    """Return mean and standard deviation over seeds, a line a learner, problem and reward; Platform last."""
    lines = [
        "| learner | problem | reward | seeds | score | success | presses | wall | CPU | presses to 1.97 | after |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    cases = groups(results, "low", "problem", "reward").items()
    for (low, problem, reward), rows in sorted(cases, key=lambda case: (case[0][1] not in BOATS, case[0][2])):
        score, success = ([row[name] for row in rows] for name in ("score", "success"))
        wall, cpu, presses = (np.mean([row[name] for row in rows]) for name in ("wall_s", "cpu_s", "presses"))
        reached = [row for row in rows if row["presses_to_people"]]
        first = ["-", "-"]
        if len(reached) == len(rows):
            to = [np.mean([row[name] for row in rows]) for name in ("presses_to_people", "wall_s_to_people")]
            first = [f"{to[0]:,.0f}", f"{to[1]:.0f} s"]
        lines.append(
            f"| {low} | {problem} | {reward} | {len(rows)} | {spread(score)} | "
            f"{np.mean(success):.1%} | {presses:,.0f} | {wall:.0f} s | {cpu:.0f} s | {first[0]} | {first[1]} |"
        )
    return "\n".join(lines)


def draw(curves: Rows, results: Rows, reward: str, x: str, path: Path) -> None:
    """Draw the learning curves of one reward, a panel a boat: mean over seeds and one standard deviation."""
    chosen = [row for row in curves if row["reward"] == reward and row["problem"] in BOATS]
    boats = sorted({row["problem"] for row in chosen})
    figure = Figure(figsize=(6.4 * len(boats), 4.2), layout="constrained")
    for axes, boat in zip(figure.subplots(1, len(boats), squeeze=False)[0], boats, strict=True):
        of_boat = [row for row in chosen if row["problem"] == boat]
        ends = [_draw_learner(axes, runs, low, x) for (low,), runs in groups(of_boat, "low").items() if low in COLOURS]
        _draw_lines(axes, [row for row in results if row["problem"] == boat], boat)
        axes.legend(loc="lower right", fontsize=8, frameon=False)
        axes.set_xscale("log")
        axes.set_xlim(right=max(ends) * 1.1)
        axes.set_ylim(-1.3, 3.7)
        axes.set_title(f"{boat} boat, {_REWARDS[reward]} reward", loc="left", fontweight="bold", fontsize=10)
        axes.set_xlabel("presses" if x == "frames" else "seconds of training, evaluations included")
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_ylabel("score, greedy, 1,000 layouts")
    with mpl.rc_context({"font.size": 9}):
        figure.savefig(path, dpi=130)


def _draw_learner(axes: Axes, runs: Rows, low: str, x: str) -> float:
    at, mean, deviation = curve(runs, x, "eval/score")
    late = at > 0
    axes.plot(at[late], mean[late], color=COLOURS[low], linewidth=1.8, label=low)
    axes.fill_between(
        at[late], (mean - deviation)[late], (mean + deviation)[late], color=COLOURS[low], alpha=0.18, lw=0
    )
    return float(at[-1])


def _draw_lines(axes: Axes, results: Rows, boat: str) -> None:
    lines = {
        "ceiling": (results[0]["ceiling"], "#2b2b2b", "-"),
        "people": (HUMAN[boat]["score"], "#D98200", "--"),
        "random": (results[0]["random"], "#8c8c8c", ":"),
    }
    for name, (height, colour, style) in lines.items():
        axes.axhline(height, color=colour, linestyle=style, linewidth=1.0, zorder=1)
        axes.annotate(f"{name} {height:.2f}", (0.005, height + 0.04), xycoords=("axes fraction", "data"), fontsize=8)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    names = ("results", "curves")
    if folders:
        write_tables(HERE, dict(zip(names, gather(finished(folders)), strict=True)))
    results, curves = (read_csv(HERE / f"{name}.csv") for name in names)
    draw(curves, results, "given", "frames", HERE / "curves.png")
    draw(curves, results, "sparse", "frames", HERE / "curves_sparse.png")
    draw(curves, results, "given", "wall_s", HERE / "curves_seconds.png")
    print(table(results))


if __name__ == "__main__":
    main(sys.argv[1:])
