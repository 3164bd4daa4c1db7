"""Draw and tabulate the learners' results under the rules of the released environment.

python experiments/released/study.py FOLDER...   gathers the finished runs in these folders into learned.csv and
                                                 curves.csv, then draws and tabulates
python experiments/released/study.py             draws and tabulates the stored csv files
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from experiments.study_tables import Rows, Run, add_to_tables, curve, gathered, groups, markdown_table, read_csv
from hpamdp.figure_style import LEARNER_COLOURS
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
BOATS = ("congruent", "incongruent")
SHARES = ("success", "wall", "out_of_fuel", "time_limit")
EVALUATION_COLUMNS = ("frames", "eval/score", "eval/success")
IDLING_RETURN = 1_979  # of 980 idle presses and then docking: claims.py


def gather(runs: Sequence[Run]) -> dict[str, Rows]:
    """Return a row for each run and for each evaluation under the released rules, by learner and boat."""
    learned: Rows = []
    curves: Rows = []
    for run in runs:
        summary = run.summary
        name = {"low": summary["low"], "boat": run.config["env"]["controller"], "seed": summary["seed"]}
        learned.append(
            {
                **name,
                "score": round(summary["score"], 4),
                **{share: round(summary[share], 4) for share in SHARES},
                "presses": round(summary["steps"], 4),
                "frames": summary["frames"],
            }
        )
        for row in run.evaluations():
            curves.append({**name, **{column: round(row[column], 4) for column in EVALUATION_COLUMNS}})
    return {"learned": sorted(learned, key=_order), "curves": sorted(curves, key=_order)}


def _order(row: dict[str, Any]) -> tuple[int, str]:
    return list(LEARNER_COLOURS).index(row["low"]), row["boat"]


def table(rows: Rows) -> str:
    """Return a line for each learner and boat, with single seeds, which differ too much for a mean."""
    lines = []
    for (low, boat), runs in groups(rows, "low", "boat").items():
        formats = {"score": ".1f", "success": ".0%", "time_limit": ".0%", "presses": ".0f"}
        cells = [", ".join(f"{run[column]:{style}}" for run in runs) for column, style in formats.items()]
        lines.append([low, boat, f"{runs[0]['frames']:,.0f}", *cells])
    head = "learner | controller | trained | return, by seed | docks in | idles to the limit in | presses an episode"
    return markdown_table(head, lines)


def draw(curves: Rows, path: Path) -> None:
    """Draw return and success against presses, a row for each controller: each seed, and the mean over seeds."""
    figure = Figure(figsize=(11.5, 7.2), layout="constrained")
    for boat, (left, right) in zip(BOATS, figure.subplots(2, 2, sharex=True), strict=True):
        of_boat = [row for row in curves if row["boat"] == boat]
        _draw_learners(left, of_boat, "eval/score")
        _draw_learners(right, of_boat, "eval/success")
        left.set_yscale("symlog", linthresh=1.0)
        left.set(ylim=(-1.0, 3_000), ylabel="return, greedy")
        left.axhline(IDLING_RETURN, color="#2b2b2b", linewidth=1.0)
        left.annotate(
            "idling 980 times, then docking",
            (0.995, IDLING_RETURN),
            xytext=(0, -10),
            fontsize=8,
            ha="right",
            xycoords=("axes fraction", "data"),
            textcoords="offset points",
        )
        right.set(ylim=(0.0, 1.04), ylabel="share of episodes docked, greedy")
        right.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        for axes in (left, right):
            axes.set(xscale="log", xlabel="presses")
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_title(f"{boat} boat, released rules", loc="left", fontweight="bold", fontsize=10)
        right.legend(fontsize=8, frameon=False, loc="upper left")
    figure.savefig(path, dpi=130)


def _draw_learners(axes: Axes, rows: Rows, column: str) -> None:
    late = [row for row in rows if row["frames"] > 0]  # the axis is logarithmic
    for (low,), of_learner in groups(late, "low").items():
        for run in groups(of_learner, "seed").values():
            x = [row["frames"] for row in run]
            y = [row[column] for row in run]
            axes.plot(x, y, color=LEARNER_COLOURS[low], linewidth=0.7, alpha=0.5)
        x, mean, _ = curve(of_learner, "frames", column)
        axes.plot(x, mean, color=LEARNER_COLOURS[low], linewidth=1.8, label=low)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        add_to_tables(
            HERE,
            gathered(folders, gather, settings={"boatdock_released.controller": None}, env=("boatdock_released",)),
            ("low", "boat", "seed"),
            sorts=False,
        )
    draw(read_csv(HERE / "curves.csv"), HERE / "figure2.png")
    print(table(read_csv(HERE / "learned.csv")))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
