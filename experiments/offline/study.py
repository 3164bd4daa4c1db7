"""Gather the offline learners' runs and those that went on from them, and draw and tabulate them.

python experiments/offline/study.py multirun/offline multirun/finetune   reads the runs, writes csv files, then draws
python experiments/offline/study.py                                      draws and tabulates what the csv files hold
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from hpamdp.analysis.study import Rows, Run, curve, finished, groups, read_csv, spread, write_tables
from hpamdp.env.boatdock.reference import HUMAN

HERE = Path(__file__).resolve().parent
PEOPLE = HUMAN["chosen"]["score"]
COLOURS = {"bc": "#8c8c8c", "iql": "#0072B2", "td3_bc": "#D55E00"}
OUTCOMES = ("success", "too_fast", "out_of_bounds", "out_of_fuel")
OFFLINE, PRETRAINED, SCRATCH = "offline", "pretrained", "scratch"


def gather(runs: Sequence[Run]) -> tuple[Rows, Rows]:
    """Return a row a run, and a row an evaluation."""
    results, curves = [], []
    for run in runs:
        summary, config = run.summary, run.config
        start = OFFLINE
        if config.mode != "offline":
            start = SCRATCH if config.low.checkpoint is None else PRETRAINED
        data = "none" if start != OFFLINE else "settled" if config.data.rest_to_rest else "recorded"
        which = "successes" if data != "none" and config.data.successes else "all"
        name = {"low": summary["low"], "start": start, "data": data, "episodes": which, "seed": summary["seed"]}
        rows = run.evaluations()
        reached = next((row["frames"] for row in rows if row["eval/score"] >= PEOPLE), "")
        figures = {key: round(summary[key], 4) for key in ("score", *OUTCOMES, "presses")}
        results.append(name | figures | {"frames_to_people": reached, "cpu_s": round(summary["cpu_s"], 1)})
        curves += [
            name | {"frames": row["frames"], "score": round(row["eval/score"], 4)}
            for row in rows
            if "eval/score" in row
        ]
    return results, curves


def table(results: Rows) -> str:
    """Return what the offline learners come to, then the presses that pre-training spares."""
    lines = [
        "| learner | presses as | episodes | seeds | score | success | too fast | out | no fuel | presses | CPU |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    offline = [row for row in results if row["start"] == OFFLINE]
    for (low, data, which), rows in groups(offline, "low", "data", "episodes").items():
        shares = [f"{np.mean([row[key] for row in rows]):.1%}" for key in OUTCOMES]
        presses, cpu_s = (np.mean([row[key] for row in rows]) for key in ("presses", "cpu_s"))
        name, score = f"| {low} | {data} | {which} | {len(rows)}", spread([row["score"] for row in rows])
        lines.append(f"{name} | {score} | {' | '.join(shares)} | {presses:.2f} | {cpu_s:.0f} s |")
    lines += ["", "| learner | start | presses to 1.97, by seed | score at the end |", "|---|---|---|---|"]
    online = [row for row in results if row["start"] != OFFLINE]
    for (low, start), rows in groups(online, "low", "start").items():
        reached = ", ".join(
            "never" if row["frames_to_people"] == "" else f"{row['frames_to_people']:,.0f}" for row in rows
        )
        lines.append(f"| {low} | {start} | {reached} | {spread([row['score'] for row in rows])} |")
    return "\n".join(lines)


def draw(curves: Rows, path: Path) -> None:
    """Draw the scores against updates from the data set, and against presses from scratch and after pre-training."""
    figure = Figure(figsize=(12.0, 4.0), layout="constrained")
    offline, online = figure.subplots(1, 2, sharey=True)
    rest_to_rest = [
        row for row in curves if row["start"] == OFFLINE and row["data"] == "settled" and row["episodes"] == "all"
    ]
    for (low,), rows in groups(rest_to_rest, "low").items():
        _draw_curve(offline, rows, low, COLOURS[low], "-")
    fresh = [row for row in curves if row["start"] != OFFLINE]
    for (low, start), rows in groups(fresh, "low", "start").items():
        _draw_curve(online, rows, f"{low}, {start}", COLOURS[low], "-" if start == PRETRAINED else ":")
    for axes, x, title in ((offline, "updates", "from people's presses alone"), (online, "presses", "then on its own")):
        axes.axhline(PEOPLE, color="#D98200", linestyle="--", linewidth=1.0)
        axes.set_title(title, loc="left", fontsize=10, fontweight="bold")
        axes.set_xlabel(x)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=8, frameon=False, loc="lower right")
    offline.set_ylabel("score, greedy, 1,000 layouts")
    offline.annotate("people 1.97", (0.01, PEOPLE + 0.06), xycoords=("axes fraction", "data"), fontsize=8)
    figure.savefig(path, dpi=130)


def _draw_curve(axes: Axes, rows: Rows, label: str, colour: str, style: str) -> None:
    x, mean, deviation = curve(rows, "frames", "score")
    axes.plot(x, mean, style, color=colour, linewidth=1.6, label=label)
    axes.fill_between(x, mean - deviation, mean + deviation, color=colour, alpha=0.15, linewidth=0)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        write_tables(HERE, dict(zip(("results", "curves"), gather(finished(folders)), strict=True)))
    results, curves = read_csv(HERE / "results.csv"), read_csv(HERE / "curves.csv")
    draw(curves, HERE / "curves.png")
    print(table(results))


if __name__ == "__main__":
    main(sys.argv[1:])
