"""Draw and tabulate the paper's five learners beside its Table 1, people, and the ceiling.

python experiments/table1/study.py                    from the csv files of experiments/learners, whose runs these are
python experiments/table1/study.py multirun/table1    from other runs: writes results.csv and curves.csv here first, and
                                                      reads these from then on
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from hpamdp.reference import HUMAN, HUMAN_SUCCESS_BY_BLOCK, RANDOM, human_normalised
from hpamdp.study import Rows, Run, curve, finished, groups, interquartile_mean, read_csv, spread, write_csv

HERE = Path(__file__).resolve().parent
LEARNERS = HERE.parent / "learners"
BOATS = ("congruent", "incongruent")
COLOURS = {"hppo": "#0072B2", "pdqn": "#009E73", "hyar": "#CC79A7", "qpamdp": "#E69F00", "dlpa": "#56B4E9"}
PEOPLE, INK, FAINT = "#D98200", "#2b2b2b", "#8c8c8c"
# The paper's Table 1: mean and deviation, congruent and incongruent.
PAPER = {
    "hppo": (".6720 ± .16", ".1448 ± .58"),
    "pdqn": (".0073 ± .003", "-1.73 ± .0002"),
    "hyar": (".005 ± .0005", "-1.3623 ± .223"),
    "qpamdp": ("-1.6758 ± .0002", "-1.7410 ± .0001"),
    "dlpa": (".2441 ± .64", ".1484 ± .29"),
    "people": ("3.0163 ± .87", "2.9318 ± .94"),
}
BLOCK = 60  # episodes
PANELS = {
    "score": ("score, greedy", -1.3, 3.8),
    "success": ("share of episodes docked, greedy", 0.0, 1.04),
}


def gather(runs: Sequence[Run]) -> tuple[Rows, Rows]:
    """Return a row a run on the boats and a row an evaluation, in the columns of experiments/learners used here."""
    results, curves = [], []
    for run in (run for run in runs if run.summary["env"] == "boatdock"):  # no score elsewhere is this one
        summary, rows = run.summary, run.evaluations()
        name = {"low": summary["low"], "problem": summary["controller"]}
        name |= {"reward": "sparse" if run.config.env.get("reward") == "sparse" else "given", "seed": summary["seed"]}
        reached = next((row["frames"] for row in rows if row["eval/score"] >= HUMAN["chosen"]["score"]), "")
        results.append(
            name
            | {key: round(summary[key], 4) for key in ("score", "success", "ceiling")}
            | {"random": round(summary["references"]["random"]["score"], 4)}
            | {"presses": summary["frames"], "presses_to_people": reached}
        )
        curves += [name | {key: round(row[key], 4) for key in ("frames", "eval/score", "eval/success")} for row in rows]
    return results, curves


def load(folder: Path) -> tuple[Rows, Rows]:
    """Return the rows of the paper's learners and boats under the given reward."""
    results, curves = (read_csv(folder / f"{name}.csv") for name in ("results", "curves"))
    return tuple(
        [row for row in rows if row["low"] in COLOURS and row["problem"] in BOATS and row["reward"] == "given"]
        for rows in (results, curves)
    )


def summarise(results: Rows) -> Rows:
    """Return a row a learner and boat: what its seeds come to, and the paper's number."""
    rows = []
    for (low, boat), of in sorted(groups(results, "low", "problem").items(), key=lambda item: _order(*item[0])):
        scores = [row["score"] for row in of]
        middle, low_end, high_end = interquartile_mean(scores)
        figures = {
            "score": np.mean(scores),
            "interquartile_mean": middle,
            "interval_low": low_end,
            "interval_high": high_end,
            "human_normalised": human_normalised(float(np.mean(scores)), boat),
            "success": np.mean([row["success"] for row in of]),
        }
        rows.append(
            {"learner": low, "boat": boat, "seeds": len(of), "spread": spread(scores)}
            | {name: round(float(value), 4) for name, value in figures.items()}
            | {"paper": PAPER[low][BOATS.index(boat)]}
        )
    return rows


def _order(low: str, boat: str) -> tuple[int, int]:
    return list(COLOURS).index(low), BOATS.index(boat)


def table(rows: Rows, results: Rows) -> str:
    """Return the learners' lines, then people's, the ceiling's and those of random presses."""
    lines = [
        "| | boat | score | interquartile mean (95 %) | random 0, people 1 | success | the paper's number |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['learner']} | {row['boat']} | {row['spread']} | {row['interquartile_mean']:.3f} "
        f"({row['interval_low']:.3f} to {row['interval_high']:.3f}) | {row['human_normalised']:.3f} | "
        f"{row['success']:.1%} | {row['paper']} |"
        for row in rows
    ]
    for boat, paper in zip(BOATS, PAPER["people"], strict=True):
        people = HUMAN[boat]
        lines.append(f"| people | {boat} | {people['score']:.3f} | | 1 | {people['success']:.1%} | {paper} (*) |")
    for boat in BOATS:
        (ceiling,) = {row["ceiling"] for row in results if row["problem"] == boat}
        lines.append(f"| ceiling | {boat} | {ceiling:.3f} | | {human_normalised(ceiling, boat):.3f} | 100.0% | |")
    lines.append(f"| random | both | {RANDOM['score']:.3f} | | 0 | {RANDOM['success']:.1%} | |")
    return "\n".join(lines)


def efficiency_table(results: Rows) -> str:
    """Return a line a learner: presses to people's score, and how far it came on both boats together."""
    lines = [
        "| learner | presses to 1.97, congruent | incongruent | presses trained "
        "| random 0, people 1: interquartile mean of the runs on both boats (95 %) |",
        "|---|---|---|---|---|",
    ]
    for low in (low for low in COLOURS if any(row["low"] == low for row in results)):
        own = [row for row in results if row["low"] == low]
        first = " | ".join(_reached([row for row in own if row["problem"] == boat]) for boat in BOATS)
        middle, low_end, high_end = interquartile_mean([human_normalised(row["score"], row["problem"]) for row in own])
        presses = np.mean([row["presses"] for row in own])
        lines.append(f"| {low} | {first} | {presses:,.0f} | {middle:.3f} ({low_end:.3f} to {high_end:.3f}) |")
    return "\n".join(lines)


def _reached(rows: Rows) -> str:
    """Return the presses to people's score of the earliest and the latest seed."""
    presses = [row["presses_to_people"] for row in rows]
    if not presses or "" in presses:
        return f"{len(presses) - presses.count('')} of {len(presses)} seeds"
    first, last = min(presses), max(presses)
    return f"{first:,.0f}" if first == last else f"{first:,.0f} to {last:,.0f}"


def draw_curves(curves: Rows, results: Rows, path: Path) -> None:
    """Draw score and success against presses, a row a boat: mean over seeds and one standard deviation."""
    figure = Figure(figsize=(11.5, 7.6), layout="constrained")
    for boat, row in zip(BOATS, figure.subplots(2, 2, sharex=True), strict=True):
        (ceiling,) = {of["ceiling"] for of in results if of["problem"] == boat}
        for key, axes in zip(PANELS, row, strict=True):
            _draw_learners(axes, curves, boat, key)
            _draw_line(axes, "ceiling", ceiling if key == "score" else 1.0, INK, "-")
            _draw_line(axes, "people", HUMAN[boat][key], PEOPLE, "--")
            _draw_line(axes, "random", RANDOM[key], FAINT, ":")
            axes.set_title(f"{boat} boat", loc="left", fontweight="bold", fontsize=10)
        row[0].legend(loc="lower right", bbox_to_anchor=(1.0, 0.18), fontsize=8, frameon=False, ncols=2)
    figure.savefig(path, dpi=130)


def _draw_learners(axes: Axes, curves: Rows, boat: str, key: str) -> None:
    for low, colour in COLOURS.items():
        rows = [row for row in curves if row["low"] == low and row["problem"] == boat]
        if not rows:
            continue
        x, mean, deviation = curve(rows, "frames", f"eval/{key}")
        late = x > 0  # the axis is logarithmic
        x, mean, deviation = x[late], mean[late], deviation[late]
        axes.plot(x, mean, color=colour, linewidth=1.8, label=low, marker="o" if len(x) < 5 else None, markersize=4)
        high = mean + deviation if key == "score" else np.minimum(mean + deviation, 1.0)
        axes.fill_between(x, mean - deviation, high, color=colour, alpha=0.18, linewidth=0)
    label, bottom, top = PANELS[key]
    axes.set(xscale="log", xlabel="presses", ylabel=label, ylim=(bottom, top))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.spines[["top", "right"]].set_visible(False)
    if key == "success":
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))


def _draw_line(axes: Axes, name: str, height: float, colour: str, style: str) -> None:
    axes.axhline(height, color=colour, linestyle=style, linewidth=1.0, zorder=1)
    text = f"{name} {height:.2f}" if axes.get_ylim()[1] > 2 else f"{name} {height:.0%}"
    axes.annotate(text, (0.995, height), xytext=(0, 2), xycoords=("axes fraction", "data"),
                  textcoords="offset points", fontsize=8, ha="right")  # fmt: skip


def draw_efficiency(curves: Rows, results: Rows, path: Path) -> None:
    """Draw success against presses with people's own learning beside it, and the presses to people's score."""
    figure = Figure(figsize=(15.0, 4.2), layout="constrained")
    *panels, last = figure.subplots(1, 3)
    presses = (np.arange(len(HUMAN_SUCCESS_BY_BLOCK)) + 0.5) * BLOCK * HUMAN["chosen"]["presses"]
    for boat, axes in zip(BOATS, panels, strict=True):
        _draw_learners(axes, curves, boat, "success")
        axes.plot(presses, HUMAN_SUCCESS_BY_BLOCK, "s--", color=PEOPLE, markersize=4, label="a person, either boat")
        _draw_line(axes, "random", RANDOM["success"], FAINT, ":")
        axes.set_title(f"{boat} boat", loc="left", fontweight="bold", fontsize=10)
        axes.legend(loc="center left", bbox_to_anchor=(0.0, 0.38), fontsize=8, frameon=False)
    lows = [low for low in COLOURS if any(row["low"] == low for row in results)]
    for offset, marker, boat in ((0.12, "o", "congruent"), (-0.12, "^", "incongruent")):
        rows = [row for row in results if row["problem"] == boat and row["presses_to_people"] != ""]
        y = [lows.index(row["low"]) + offset for row in rows]
        colours = [COLOURS[row["low"]] for row in rows]
        last.scatter([row["presses_to_people"] for row in rows], y, c=colours, marker=marker, s=28, label=boat)
    last.set(xscale="log", xlabel="presses to people's mean score, 1.97")
    last.set_yticks(range(len(lows)), lows)
    last.xaxis.set_major_formatter(EngFormatter(sep=""))
    last.set_title("first evaluation at 1.97, each seed", loc="left", fontweight="bold", fontsize=10)
    last.spines[["top", "right"]].set_visible(False)
    last.legend(fontsize=8, frameon=False)
    figure.savefig(path, dpi=130)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        for name, rows in zip(("results", "curves"), gather(finished(folders)), strict=True):
            write_csv(HERE / f"{name}.csv", rows)
    source = HERE if (HERE / "results.csv").exists() else LEARNERS
    print(f"From the runs of {source.name}/results.csv and curves.csv\n")
    results, curves = load(source)
    rows = summarise(results)
    write_csv(HERE / "table1.csv", rows)
    draw_curves(curves, results, HERE / "figure2.png")
    draw_efficiency(curves, results, HERE / "efficiency.png")
    print(table(rows, results), efficiency_table(results), sep="\n\n")


if __name__ == "__main__":
    main(sys.argv[1:])
