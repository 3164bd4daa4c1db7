"""Tabulate runs of six selectors over eight learners with default settings.

python experiments/whole_map/study.py FOLDER...    adds the runs in these folders to the csv files
python experiments/whole_map/study.py              prints both tables, and draws practice and value over time
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, MaxNLocator, PercentFormatter

from experiments.study_tables import Rows, Run, add_to_tables, difference, gathered, groups, read_csv
from hpamdp.analysis.statistics import spread
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
LEARNERS = ("hppo", "pdqn", "hyar", "hsac", "paddpg", "dlpa", "qpamdp", "pets")
SELECTORS = ("value", "meta_critic", "linucb", "lin_thompson", "actor", "ucb")
# With `high=none` the choice is that of `env.controller`.
CELL = ("high", "controller", "low", "frames")
COLUMNS = {
    "score": "score",
    "ceiling": "ceiling",
    "agreement": "oracle_agreement",
    "weighted": "oracle_agreement_weighted",
    "regret": "regret",
    "gain": "choice_gain",
    "score_congruent": "score_congruent",
    "score_incongruent": "score_incongruent",
    "cpu_s": "cpu_s",
}


def gather(runs: Sequence[Run]) -> tuple[Rows, Rows]:
    """Return a row for each run, and one for each of its evaluations."""
    results: Rows = []
    curves: Rows = []
    for run in runs:
        name = {
            "high": run.summary["high"],
            "controller": run.config["env"]["controller"],
            "low": run.summary["low"],
            "frames": run.summary["frames"],
            "seed": run.summary["seed"],
        }
        figures = {column: run.summary.get(key) for column, key in COLUMNS.items()}
        practised = run.summary.get("practised", {}).get("congruent")
        results.append(
            {**name, **{column: _rounded(value) for column, value in {**figures, "practised": practised}.items()}}
        )
        for row in run.evaluations():
            if "eval/score_congruent" in row:
                of_run = ("eval/score", "eval/score_congruent", "eval/score_incongruent", "eval/oracle_agreement")
                values = {column.removeprefix("eval/"): _rounded(row[column]) for column in of_run}
                congruent = _rounded(row.get("train/option_congruent"))
                curves.append({**name, "step": row["frames"], **values, "congruent": congruent})
    return results, curves


def _rounded(value: float | None) -> float | str:
    return "" if value is None else round(value, 4)


def single(rows: Rows, low: str) -> Rows:
    """Return the runs of a learner with the controller, held in all episodes, that has the higher mean score."""
    cells = groups([row for row in rows if row["high"] == "none" and row["low"] == low], "controller").values()
    return max(cells, key=lambda cell: float(np.mean([row["score"] for row in cell])), default=[])


def of_usual_length(rows: Rows, low: str) -> Rows:
    """Return the runs of a learner under selectors, of the length that most selectors have."""
    of_low = [row for row in rows if row["low"] == low and row["high"] != "none"]
    lengths = groups(of_low, "frames").values()
    return max(lengths, key=lambda runs: len({row["high"] for row in runs}), default=[])


def table(rows: Rows) -> str:
    """Return the map: mean score and number of seeds of each selector over each learner."""
    selectors = [high for high in SELECTORS if any(row["high"] == high for row in rows)]
    lines = ["| learner | presses | " + " | ".join(selectors) + " |", "|---" * (len(selectors) + 2) + "|"]
    for low in LEARNERS:
        runs = of_usual_length(rows, low)
        if not runs:
            continue
        cells = []
        for high in selectors:
            scores = [row["score"] for row in runs if row["high"] == high]
            agreement = [row["agreement"] for row in runs if row["high"] == high]
            cells.append(f"{spread(scores, 2)}, {np.mean(agreement):.0%} ({len(scores)})" if scores else "-")
        lines.append(f"| {low} | {runs[0]['frames']:,.0f} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def choosing(rows: Rows) -> str:
    """Return a line for each cell of choosing selectors with three seeds or more: score, and score over one boat.

    UCB cannot see the layout, so it does not choose.
    """
    lines = [
        "| selector | learner | presses | n | score | below the ceiling | over one boat | oracle's | weighted | "
        "regret | CPU |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for (high, low, frames), runs in groups(rows, "high", "low", "frames").items():
        if high in ("none", "ucb") or len(runs) < 3:
            continue
        alone = single(rows, low)
        columns = ("score", "ceiling", "agreement", "weighted", "regret", "cpu_s")
        mean = {column: np.mean([row[column] for row in runs]) for column in columns}
        over = str(difference([row["score"] for row in runs], [row["score"] for row in alone])) if alone else ""
        lines.append(
            f"| {high} | {low} | {frames:,.0f} | {len(runs)} | {spread([row['score'] for row in runs])} | "
            f"{mean['ceiling'] - mean['score']:.3f} | {over} | {mean['agreement']:.1%} | {mean['weighted']:.1%} | "
            f"{mean['regret']:.3f} | {mean['cpu_s']:.0f} s |"
        )
    return "\n".join(lines)


def draw(curves: Rows, path: Path) -> None:
    """Draw the score, and the practice of one controller, over a run: a column for each learner that has curves.

    Runs with three evaluations or fewer, such as those with `eval.every=0`, have none.
    """
    curves = [row for run in groups(curves, *CELL, "seed").values() if len(run) > 3 for row in run]
    lows = [low for low in LEARNERS if any(row["low"] == low for row in curves)]
    figure = Figure(figsize=(2.7 * len(lows), 4.6), layout="constrained")
    axes = figure.subplots(2, len(lows), sharey="row", squeeze=False)
    for place, low in enumerate(lows):
        of_low = [row for row in curves if row["low"] == low]
        lengths = groups(of_low, "frames")
        usual = max(lengths, key=lambda length: len({row["high"] for row in lengths[length]}))
        for (high, seed), run in groups(lengths[usual], "high", "seed").items():
            is_first = seed == min(row["seed"] for row in lengths[usual] if row["high"] == high)
            style = {"color": f"C{SELECTORS.index(high)}", "alpha": 0.7, "label": high if is_first else None}
            steps = [row["step"] for row in run]
            axes[0][place].plot(steps, [row["score"] for row in run], **style)
            practice = [np.nan if row["congruent"] == "" else row["congruent"] for row in run]
            axes[1][place].plot(steps, practice, color=style["color"], alpha=0.7)
        axes[0][place].set_title(low, fontsize=10)
        axes[1][place].set_xlabel("presses")
        for each in axes[:, place]:
            each.xaxis.set_major_locator(MaxNLocator(3))
            each.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes[0][0].set_ylabel("score")
    axes[1][0].set_ylabel("congruent boat, training")
    axes[1][0].yaxis.set_major_formatter(PercentFormatter(1.0))
    labelled = {line.get_label(): line for line in figure.findobj(Line2D) if not line.get_label().startswith("_")}
    handles = [labelled[high] for high in SELECTORS if high in labelled]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(SELECTORS), frameon=False, fontsize=8)
    figure.savefig(path, dpi=130)


def main(folders: Sequence[str]) -> None:
    """Gather, tabulate, draw."""
    if folders:
        results, curves = gathered(folders, gather, env=("boatdock",), settings={"boatdock.controller": None})
        add_to_tables(HERE, {"runs": results, "curves": curves}, (*CELL, "seed"))
    rows, curves = (read_csv(HERE / f"{name}.csv") for name in ("runs", "curves"))
    print(f"{table(rows)}\n\n{choosing(rows)}")
    draw(curves, HERE / "curves.png")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
