"""Draw and tabulate the paper's five learners beside its Table 1, people, and the ceiling.

python experiments/table1/study.py FOLDER...    gathers the runs of experiment=table1, sparse and sample_efficiency
                                                in these folders into results.csv, curves.csv and efficiency.csv, then
                                                draws and tabulates
python experiments/table1/study.py              draws and tabulates what these hold
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from hpamdp.analysis.study import Rows, Run, curve, finished, groups, interquartile_mean, read_csv, spread, write_tables
from hpamdp.env.boatdock.reference import HUMAN, RANDOM, human_normalised

HERE = Path(__file__).resolve().parent
PEOPLE_BY_BLOCK = HERE.parent / "human" / "blocks.csv"
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
SEEDS = (0, 1, 2)
BLOCK = 60  # episodes
PANELS = {
    "score": ("score, greedy", -1.3, 3.8),
    "success": ("share of episodes docked, greedy", 0.0, 1.04),
}


def gather(runs: Sequence[Run]) -> dict[str, Rows]:
    """Return a row a full-length run, and a row an evaluation of these and of those that ended at people's score."""
    found: dict[str, Rows] = {"results": [], "curves": [], "efficiency": []}
    for run in runs:
        summary = run.summary
        if (summary["env"], summary["high"]) != ("boatdock", "none") or summary["low"] not in COLOURS:
            continue
        name = {"low": summary["low"], "boat": summary["controller"]}
        name |= {"reward": "sparse" if run.config.env.reward == "sparse" else "given", "seed": summary["seed"]}
        keys = ("frames", "wall_s", "eval/score", "eval/success")
        evaluations = [name | {key: round(row[key], 4) for key in keys} for row in run.evaluations()]
        if run.config.eval.get("stop_score") is not None:
            found["efficiency"] += evaluations
            continue
        found["curves"] += evaluations
        found["results"].append(
            name
            | {key: round(summary[key], 4) for key in ("score", "success", "ceiling")}
            | {"presses": summary["frames"], "cpu_s": round(summary["cpu_s"], 1)}
        )
    return found


def missing(tables: dict[str, Rows]) -> list[str]:
    """Return a line for each experiment, learner and boat of whose three runs some are in none of the tables."""
    kinds = {
        "table1": ("results", "given"),
        "sparse": ("results", "sparse"),
        "sample_efficiency": ("efficiency", "given"),
    }
    lines = []
    for (experiment, (name, reward)), low, boat in itertools.product(kinds.items(), COLOURS, BOATS):
        there = {row["seed"] for row in tables[name] if (row["low"], row["boat"], row["reward"]) == (low, boat, reward)}
        lacking = [str(seed) for seed in SEEDS if seed not in there]
        if lacking:
            lines.append(f"{experiment}: no run of {low}, {boat}, seed {', '.join(lacking)}")
    return lines


def summarise(results: Rows) -> Rows:
    """Return a row a learner and boat: what its seeds come to, and the paper's number."""
    rows = []
    for (low, boat), of in sorted(groups(results, "low", "boat").items(), key=lambda item: _order(*item[0])):
        scores = [row["score"] for row in of]
        middle, low_end, high_end = interquartile_mean(scores)
        figures = {
            "score": np.mean(scores),
            "interquartile_mean": middle,
            "interval_low": low_end,
            "interval_high": high_end,
            "human_normalised": human_normalised(float(np.mean(scores)), boat),
            "success": np.mean([row["success"] for row in of]),
            "presses": np.mean([row["presses"] for row in of]),
            "cpu_s": np.mean([row["cpu_s"] for row in of]),
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
        "| | boat | score | interquartile mean (95 %) | random 0, people 1 | success | presses | CPU | the paper's |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['learner']} | {row['boat']} | {row['spread']} | {row['interquartile_mean']:.3f} "
        f"({row['interval_low']:.3f} to {row['interval_high']:.3f}) | {row['human_normalised']:.3f} | "
        f"{row['success']:.1%} | {row['presses']:,.0f} | {row['cpu_s']:.0f} s | {row['paper']} |"
        for row in rows
    ]
    for boat, paper in zip(BOATS, PAPER["people"], strict=True):
        people = HUMAN[boat]
        lines.append(
            f"| people | {boat} | {people['score']:.3f} | | 1 | {people['success']:.1%} | 1,170 | | {paper} (*) |"
        )
    for boat in BOATS:
        (ceiling,) = {row["ceiling"] for row in results if row["boat"] == boat}
        lines.append(f"| ceiling | {boat} | {ceiling:.3f} | | {human_normalised(ceiling, boat):.3f} | 100.0% | | | |")
    lines.append(f"| random | both | {RANDOM['score']:.3f} | | 0 | {RANDOM['success']:.1%} | | | |")
    return "\n".join(lines)


def sparse_table(given: Rows, sparse: Rows) -> str:
    """Return a line a learner: its scores after learning from either reward."""
    boats = [f"{boat}, {reward}" for boat in BOATS for reward in ("given", "sparse")]
    lines = [f"| learner | {' | '.join(boats)} |", "|---|---|---|---|---|"]
    for low in (low for low in COLOURS if any(row["low"] == low for row in sparse)):
        cells = []
        for boat in BOATS:
            for rows in (given, sparse):
                scores = [row["score"] for row in rows if (row["low"], row["boat"]) == (low, boat)]
                cells.append(spread(scores) if scores else "")
        lines.append(f"| {low} | {' | '.join(cells)} |")
    return "\n".join(lines)


def efficiency_table(efficiency: Rows, results: Rows) -> str:
    """Return a line a learner: presses to people's score, and how far it came on both boats together."""
    lines = [
        "| learner | presses to 1.97, congruent | incongruent | wall seconds, both "
        "| random 0, people 1: interquartile mean of the full-length runs on both boats (95 %) |",
        "|---|---|---|---|---|",
    ]
    for low in (low for low in COLOURS if any(row["low"] == low for row in efficiency)):
        runs = groups([row for row in efficiency if row["low"] == low], "boat", "seed")
        first = {run: _first_at_people(rows) for run, rows in runs.items()}
        presses = (_range([first[run] for run in runs if run[0] == boat], "frames") for boat in BOATS)
        cells = " | ".join([*presses, _range(list(first.values()), "wall_s")])
        own = [human_normalised(row["score"], row["boat"]) for row in results if row["low"] == low]
        middle, low_end, high_end = interquartile_mean(own)
        lines.append(f"| {low} | {cells} | {middle:.3f} ({low_end:.3f} to {high_end:.3f}) |")
    return "\n".join(lines)


def _first_at_people(rows: Rows) -> dict[str, Any] | None:
    """Return a run's first evaluation at people's score."""
    return next((row for row in rows if row["eval/score"] >= HUMAN["chosen"]["score"]), None)


def _range(rows: Sequence[dict[str, Any] | None], key: str) -> str:
    """Return the least and the most of the runs that came there, and how many did unless all."""
    values = [row[key] for row in rows if row is not None]
    some = "" if len(values) == len(rows) else f" ({len(values)} of {len(rows)} seeds)"
    if not values:
        return some.strip(" ()")
    first, last = f"{min(values):,.0f}", f"{max(values):,.0f}"
    return (first if first == last else f"{first} to {last}") + some


def draw_curves(curves: Rows, results: Rows, path: Path) -> None:
    """Draw score and success against presses, a row a boat: mean over seeds and one standard deviation."""
    figure = Figure(figsize=(11.5, 7.6), layout="constrained")
    for boat, row in zip(BOATS, figure.subplots(2, 2, sharex=True), strict=True):
        (ceiling,) = {of["ceiling"] for of in results if of["boat"] == boat}
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
        rows = [row for row in curves if row["low"] == low and row["boat"] == boat]
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


def draw_efficiency(efficiency: Rows, path: Path) -> None:
    """Draw score against presses up to people's mean, a line a seed, with people's own learning beside them."""
    figure = Figure(figsize=(12.5, 4.4), layout="constrained")
    for boat, axes in zip(BOATS, figure.subplots(1, 2, sharey=True), strict=True):
        for low, colour in COLOURS.items():
            own = [row for row in efficiency if (row["low"], row["boat"]) == (low, boat)]
            for i, rows in enumerate(groups(own, "seed").values()):
                late = [row for row in rows if row["frames"]]  # the axis is logarithmic
                x, y = ([row[key] for row in late] for key in ("frames", "eval/score"))
                axes.plot(x, y, color=colour, linewidth=1.0, alpha=0.6)
                reached = _first_at_people(rows) or {}
                x, y = reached.get("frames"), reached.get("eval/score")
                axes.plot([x], [y], "o", color=colour, markersize=5, label=None if i else low)
        x, y = people_by_block(boat)
        axes.plot(x, y, "s--", color=PEOPLE, markersize=4, label="a person, 60 episodes a square")
        axes.set(xscale="log", xlabel="presses", xlim=(80, 1e7), ylim=(-1.1, 2.6))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_title(f"{boat} boat", loc="left", fontweight="bold", fontsize=10)
        _draw_line(axes, "people's mean", HUMAN["chosen"]["score"], PEOPLE, "--")
        _draw_line(axes, "random", RANDOM["score"], FAINT, ":")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 0.06), fontsize=8, frameon=False)
        if boat == BOATS[0]:
            axes.set_ylabel("score, greedy")
    figure.savefig(path, dpi=130)


def people_by_block(boat: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a person's presses up to the middle of each block of episodes, and people's score in it with this boat."""
    blocks = read_csv(PEOPLE_BY_BLOCK)
    num_presses = np.array([row["presses"] for row in blocks if row["controller"] == -1]) * BLOCK
    chosen = float(boat == "congruent")
    return num_presses.cumsum() - num_presses / 2, np.array(
        [row["score"] for row in blocks if row["controller"] == chosen]
    )


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        write_tables(HERE, gather(finished(folders)))
    tables = {name: read_csv(HERE / f"{name}.csv") for name in ("results", "curves", "efficiency")}
    for line in missing(tables):
        print(line, file=sys.stderr)
    results, curves, efficiency = tables.values()
    given, sparse = ([row for row in results if row["reward"] == reward] for reward in ("given", "sparse"))
    rows = summarise(given)
    write_tables(HERE, {"table1": rows})
    draw_curves([row for row in curves if row["reward"] == "given"], given, HERE / "figure2.png")
    draw_efficiency(efficiency, HERE / "efficiency.png")
    print(table(rows, given), efficiency_table(efficiency, given), sparse_table(given, sparse), sep="\n\n")


if __name__ == "__main__":
    main(sys.argv[1:])
