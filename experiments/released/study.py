"""Draw and tabulate what learners come to under the rules of the released environment.

python experiments/released/study.py FOLDER...   gathers the finished runs in these folders into learned.csv and
                                                 curves.csv, then draws and tabulates
python experiments/released/study.py             draws and tabulates what these hold
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from hpamdp.analysis.study import Rows, Run, curve, finished, groups, read_csv, write_tables

HERE = Path(__file__).resolve().parent
BOATS = ("congruent", "incongruent")
COLOURS = {"hppo": "#0072B2", "pdqn": "#009E73", "hyar": "#CC79A7", "qpamdp": "#E69F00", "dlpa": "#56B4E9"}
FIGURES = ("score", "success", "wall", "out_of_fuel", "time_limit", "presses")
IDLING = 1_979  # the return of 980 idle presses and then docking: claims.py


def gather(runs: Sequence[Run]) -> dict[str, Rows]:
    """Return a row a run and a row an evaluation of these, those under other rules left out."""
    found: dict[str, Rows] = {"learned": [], "curves": []}
    for run in (run for run in runs if run.summary["env"] == "boatdock_released"):
        summary = run.summary
        name = {"low": summary["low"], "boat": summary["controller"], "seed": summary["seed"]}
        found["learned"].append(name | {key: round(summary[key], 4) for key in FIGURES} | {"frames": summary["frames"]})
        keys = ("frames", "eval/score", "eval/success")
        found["curves"] += [name | {key: round(row[key], 4) for key in keys} for row in run.evaluations()]
    order = list(COLOURS)
    return {file: sorted(rows, key=lambda row: (order.index(row["low"]), row["boat"])) for file, rows in found.items()}


def table(rows: Rows) -> str:
    """Return a line a learner and boat, its seeds side by side: no mean says much about them."""
    lines = [
        "| learner | boat | trained | return, by seed | docks in | idles to the limit in | presses an episode |",
        "|---|---|---|---|---|---|---|",
    ]
    for (low, boat), of in groups(rows, "low", "boat").items():
        shares = [", ".join(f"{row[key]:.0%}" for row in of) for key in ("success", "time_limit")]
        returns, presses = (
            ", ".join(f"{row[key]:{form}}" for row in of) for key, form in (("score", ".1f"), ("presses", ".0f"))
        )
        lines.append(f"| {low} | {boat} | {of[0]['frames']:,.0f} | {returns} | {' | '.join(shares)} | {presses} |")
    return "\n".join(lines)


def draw(curves: Rows, path: Path) -> None:
    """Draw return and success against presses, a row a boat: each seed, and the mean over seeds."""
    figure = Figure(figsize=(11.5, 7.2), layout="constrained")
    for boat, (left, right) in zip(BOATS, figure.subplots(2, 2, sharex=True), strict=True):
        of = [row for row in curves if row["boat"] == boat]
        _draw_learners(left, of, "eval/score")
        _draw_learners(right, of, "eval/success")
        left.set_yscale("symlog", linthresh=1.0)
        left.set(ylim=(-1.0, 3_000), ylabel="return, greedy")
        left.axhline(IDLING, color="#2b2b2b", linewidth=1.0)
        left.annotate("idling 980 times, then docking", (0.995, IDLING), xytext=(0, -10), fontsize=8, ha="right",
                      xycoords=("axes fraction", "data"), textcoords="offset points")  # fmt: skip
        right.set(ylim=(0.0, 1.04), ylabel="share of episodes docked, greedy")
        right.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        for axes in (left, right):
            axes.set(xscale="log", xlabel="presses")
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.spines[["top", "right"]].set_visible(False)
            axes.set_title(f"{boat} boat, released rules", loc="left", fontweight="bold", fontsize=10)
        right.legend(fontsize=8, frameon=False, loc="upper left")
    figure.savefig(path, dpi=130)


def _draw_learners(axes: Axes, rows: Rows, key: str) -> None:
    for (low,), of in groups([row for row in rows if row["frames"]], "low").items():
        for each in groups(of, "seed").values():
            x, y = ([row[name] for row in each] for name in ("frames", key))
            axes.plot(x, y, color=COLOURS[low], linewidth=0.7, alpha=0.5)
        x, mean, _ = curve(of, "frames", key)
        axes.plot(x, mean, color=COLOURS[low], linewidth=1.8, label=low)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        write_tables(HERE, gather(finished(folders)))
    draw(read_csv(HERE / "curves.csv"), HERE / "figure2.png")
    print(table(read_csv(HERE / "learned.csv")))


if __name__ == "__main__":
    main(sys.argv[1:])
