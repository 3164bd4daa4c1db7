"""Gather the runs of the hierarchy's multirun into csv files, and draw and tabulate them.

python experiments/hierarchy/study.py multirun/hierarchy     reads the runs, writes the csv files, then draws
python experiments/hierarchy/study.py                        draws and tabulates what the csv files hold
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, PercentFormatter

from hpamdp.analysis.study import Rows, Run, curve, finished, groups, read_csv, spread, write_tables
from hpamdp.env.boatdock.reference import HUMAN, HUMAN_CONGRUENT_BY_OFFSET, OFFSET_EDGES

HERE = Path(__file__).resolve().parent
# Those that see the layout, those that do not, and the lines to hold them against.
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
FIGURES = {
    "score": "score",
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
    """Return a row a run, a row an evaluation, and a row a run and bin of bearings."""
    results, curves, choices = [], [], []
    for run in runs:
        summary = run.summary
        practice = run.config.agent.get("uniform_option_frames", 0)
        name = {"high": summary["high"], "low": summary["low"], "total": run.config.total_frames, "practice": practice}
        name["seed"] = summary["seed"]
        results.append(name | {column: round(summary[key], 4) for column, key in FIGURES.items()})
        for row in run.evaluations():
            told = {key: row[f"eval/{key}"] for key in ("score", "regret", "oracle_agreement")}
            drift = [abs(value) for key, value in row.items() if key.startswith("eval/drift_")]
            told["drift"] = float(np.mean(drift)) if drift else 0.0
            curves.append(name | {"frames": row["frames"]} | {key: round(value, 4) for key, value in told.items()})
        played = run.played()
        bins = np.digitize(played["bearing_offset"], OFFSET_EDGES[1:-1])
        for i, low in enumerate(OFFSET_EDGES[:-1]):
            share = played["option"][bins == i].mean()  # option 1 is the congruent boat
            choices.append(name | {"offset": low, "congruent": round(float(share), 4)})
    return results, curves, choices


def table(results: Rows) -> str:
    """Return a line a selector and learner: mean and standard deviation over seeds."""
    lines = [
        "| selector | learner | presses, uniform | n | score | oracle's | weighted | regret | gain | success | CPU |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    by_score = sorted(
        groups(results, "low", "total", "practice", "high").items(),
        key=lambda item: (*item[0][:3], -np.mean([row["score"] for row in item[1]])),
    )
    for (low, total, practice, high), rows in by_score:
        mean = {key: np.mean([row[key] for row in rows]) for key in FIGURES}
        name = f"| {high} | {low} | {total:,.0f}, {practice:,.0f} | {len(rows)}"
        score, agreement = spread([row["score"] for row in rows]), f"{mean['agreement']:.1%}"
        lines.append(
            f"{name} | {score} | {agreement} | {mean['weighted_agreement']:.1%} | {mean['regret']:.3f} | "
            f"{mean['choice_gain']:.3f} | {mean['success']:.1%} | {mean['cpu_s']:.0f} s |"
        )
    return "\n".join(lines)


def of_the_map(rows: Rows) -> Rows:
    """Return the rows of those runs of each learner that all selectors have: its commonest length, no practice."""
    lengths = {
        low: Counter(row["total"] for row in of).most_common(1)[0][0] for (low,), of in groups(rows, "low").items()
    }
    return [row for row in rows if row["total"] == lengths[row["low"]] and not row["practice"]]


def draw_map(results: Rows, path: Path) -> None:
    """Draw the scores as a map of selectors and learners."""
    lows = list(dict.fromkeys(row["low"] for row in results))
    highs = [high for high in SELECTORS if any(row["high"] == high for row in results)]
    scores = np.full((len(highs), len(lows)), np.nan)
    for (low, high), rows in groups(results, "low", "high").items():
        scores[highs.index(high), lows.index(low)] = np.mean([row["score"] for row in rows])
    figure = Figure(figsize=(1.6 + 1.5 * len(lows), 0.6 + 0.36 * len(highs)), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(scores, cmap="viridis", aspect="auto", vmin=HUMAN["chosen"]["score"], vmax=3.68)
    for (i, j), score in np.ndenumerate(scores):
        if np.isfinite(score):
            axes.text(j, i, f"{score:.2f}", ha="center", va="center", color="white" if score < 3.1 else "black")
    axes.set_xticks(range(len(lows)), lows)
    axes.set_yticks(range(len(highs)), highs)
    figure.colorbar(image, label="score: people's mean to the ceiling")
    figure.savefig(path, dpi=140)


def draw_curves(curves: Rows, key: str, label: str, path: Path) -> None:
    """Draw a figure of the evaluations against presses, a panel a learner: mean and deviation over seeds."""
    lows = list(dict.fromkeys(row["low"] for row in curves))
    figure = Figure(figsize=(6.2 * len(lows), 4.0), layout="constrained")
    for axes, low in zip(figure.subplots(1, len(lows), squeeze=False)[0], lows, strict=True):
        for high, colour in SELECTORS.items():
            rows = [row for row in curves if row["low"] == low and row["high"] == high]
            if not rows:
                continue
            x, mean, deviation = curve(rows, "frames", key)
            axes.plot(x, mean, color=colour, linewidth=1.5, label=high)
            axes.fill_between(x, mean - deviation, mean + deviation, color=colour, alpha=0.15, linewidth=0)
        _finish(axes, f"{low}", "presses", label)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.legend(fontsize=7, frameon=False, ncols=2)
    figure.savefig(path, dpi=130)


def draw_choices(choices: Rows, path: Path) -> None:
    """Draw the share of the congruent boat by the bearing's offset, a panel a learner, with people's."""
    lows = list(dict.fromkeys(row["low"] for row in choices))
    middle = np.add(OFFSET_EDGES[:-1], OFFSET_EDGES[1:]) / 2
    figure = Figure(figsize=(6.2 * len(lows), 4.0), layout="constrained")
    for axes, low in zip(figure.subplots(1, len(lows), squeeze=False)[0], lows, strict=True):
        for high, colour in SELECTORS.items():
            rows = [row for row in choices if row["low"] == low and row["high"] == high]
            if not rows or high == "human":
                continue
            shares = [np.mean([r["congruent"] for r in of]) for of in groups(rows, "offset").values()]
            axes.plot(middle, shares, color=colour, linewidth=1.5, label=high)
        axes.plot(middle, HUMAN_CONGRUENT_BY_OFFSET, "--", color=SELECTORS["human"], linewidth=2.2, label="people")
        _finish(axes, low, "degrees from the congruent boat's nearest direction", "share of the congruent boat")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.legend(fontsize=7, frameon=False, ncols=2)
    figure.savefig(path, dpi=130)


def _finish(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, loc="left", fontsize=10, fontweight="bold")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.spines[["top", "right"]].set_visible(False)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    names = ("results", "curves", "choices")
    if folders:
        write_tables(HERE, dict(zip(names, gather(finished(folders)), strict=True)))
    results, curves, choices = (read_csv(HERE / f"{name}.csv") for name in names)
    print(table(results))
    results, curves, choices = map(of_the_map, (results, curves, choices))
    draw_map(results, HERE / "map.png")
    draw_curves(curves, "regret", "regret of the greedy choice", HERE / "regret.png")
    draw_curves(curves, "score", "score, greedy, 1,000 layouts", HERE / "curves.png")
    draw_choices(choices, HERE / "choices.png")


if __name__ == "__main__":
    main(sys.argv[1:])
