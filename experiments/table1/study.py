"""Draw and tabulate the paper's five learners beside its Table 1, people, and the ceiling.

python experiments/table1/study.py FOLDER...    adds the runs of experiment=table1, sparse and sample_efficiency in
                                                these folders to results.csv, curves.csv and efficiency.csv, in the
                                                place of earlier ones of the same learner, boat, reward and seed; then
                                                draws and tabulates. A cell of cells.csv shows the seeds of the
                                                protocol once all of them have run, and until then the earlier ones.
python experiments/table1/study.py              draws and tabulates the stored csv files
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

from experiments.study_tables import (
    Rows,
    Run,
    add_to_tables,
    curve,
    difference,
    gathered,
    groups,
    markdown_table,
    middle_half,
    read_csv,
    standing_rows,
    write_tables,
)
from hpamdp.analysis.statistics import spread
from hpamdp.env.boatdock.harbour import CONTROLLERS
from hpamdp.env.boatdock.reference import HUMAN, RANDOM, human_normalised
from hpamdp.figure_style import LEARNER_COLOURS
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
HUMAN_BLOCKS = HERE.parent / "human" / "blocks.csv"
BOTH_BOATS = -1  # in the column `controller` of these
BLOCK_EPISODES = 60
BOATS = ("congruent", "incongruent")
REWARDS = ("shaped", "sparse")
EARLIER_SEEDS = (0, 1, 2)
BUDGETS = (4_000, 20_000, 100_000, 400_000, 4_000_000, 24_000_000)  # presses after which learners are compared
NEAR = 1.1  # an evaluation counts for a budget that differs by no more than this factor
TABLES = ("results", "curves", "efficiency")
CELL = ("low", "boat", "reward")
LEARNERS = ("hppo", "pdqn", "hyar", "qpamdp", "dlpa")
# Settings of the problem that may differ from its own; those with None tell rows apart.
OF_PROBLEM = {"boatdock.controller": None, "boatdock.reward": None}
OF_STUDY = {"env": ("boatdock",), "high": ("none",), "low": LEARNERS}
HUMAN_COLOUR, INK, FAINT = "#D98200", "#2b2b2b", "#8c8c8c"

# The paper's Table 1: mean and standard deviation, congruent and incongruent.
PAPER = {
    "hppo": (".6720 ± .16", ".1448 ± .58"),
    "pdqn": (".0073 ± .003", "-1.73 ± .0002"),
    "hyar": (".005 ± .0005", "-1.3623 ± .223"),
    "qpamdp": ("-1.6758 ± .0002", "-1.7410 ± .0001"),
    "dlpa": (".2441 ± .64", ".1484 ± .29"),
}
PAPER_HUMAN = ("3.0163 ± .87", "2.9318 ± .94")
HUMAN_PRESSES = "1,170"  # in the recording, for each person

# Label and limits of the vertical axis.
PANELS = {
    "score": ("score, greedy", -1.3, 3.8),
    "success": ("share of episodes docked, greedy", 0.0, 1.04),
}
EVALUATION_COLUMNS = ("frames", "wall_s", "eval/score", "eval/success")


def gather(runs: Sequence[Run]) -> dict[str, Rows]:
    """Return the rows of the csv files.

    `results` has a row for each full-length run, `curves` a row for each evaluation of these, and `efficiency` a row
    for each evaluation of the runs that ended at the human score.
    """
    results: Rows = []
    curves: Rows = []
    efficiency: Rows = []
    for run in runs:
        summary = run.summary
        name = {
            "low": summary["low"],
            "boat": summary["controller"],
            "reward": "sparse" if run.config["env"]["reward"] == "sparse" else "shaped",
            "seed": summary["seed"],
        }
        evaluations = [
            {**name, **{column: round(row[column], 4) for column in EVALUATION_COLUMNS}} for row in run.evaluations()
        ]
        if run.config["eval"].get("stop_score") is not None:
            efficiency.extend(evaluations)
            continue
        curves.extend(evaluations)
        results.append(
            {
                **name,
                "score": round(summary["score"], 4),
                "success": round(summary["success"], 4),
                "ceiling": round(summary["ceiling"], 4),
                "presses": summary["frames"],
                "cpu_s": round(summary["cpu_s"], 1),
            }
        )
    return {"results": results, "curves": curves, "efficiency": efficiency}


def _of(rows: Rows, low: str, boat: str) -> Rows:
    return [row for row in rows if row["low"] == low and row["boat"] == boat]


def summarise(results: Rows) -> Rows:
    """Return a row for each learner and boat: statistics over its seeds, and the paper's number."""
    rows = []
    for low in LEARNERS:
        for boat, paper in zip(BOATS, PAPER[low], strict=True):
            runs = _of(results, low, boat)
            if not runs:
                continue
            scores = [run["score"] for run in runs]
            figures = {
                "score": np.mean(scores),
                "below_ceiling": np.mean([run["ceiling"] - run["score"] for run in runs]),
                "human_normalised": human_normalised(float(np.mean(scores)), boat),
                "success": np.mean([run["success"] for run in runs]),
                "presses": np.mean([run["presses"] for run in runs]),
                "cpu_s": np.mean([run["cpu_s"] for run in runs]),
            }
            rows.append(
                {
                    "learner": low,
                    "boat": boat,
                    "seeds": len(runs),
                    "spread": spread(scores),
                    "interquartile_mean": middle_half(scores),
                    "above_next": _above_next(results, low, boat),
                    **{name: round(float(value), 4) for name, value in figures.items()},
                    "paper": paper,
                }
            )
    return rows


def _above_next(results: Rows, low: str, boat: str) -> str:
    """Return the difference of a learner to the next best one on this boat; empty for the last one.

    Runs may have layouts of their own, so scores are compared by their distances to the ceiling of their layouts.
    """
    scores = {name: [run["score"] - run["ceiling"] for run in _of(results, name, boat)] for name in LEARNERS}
    ranking = sorted((name for name in LEARNERS if scores[name]), key=lambda name: -np.mean(scores[name]))
    place = ranking.index(low) + 1
    return str(difference(scores[low], scores[ranking[place]])) if place < len(ranking) else ""


def ceilings(results: Rows, boat: str) -> list[float]:
    """Return the lowest and the highest mean ceiling of a learner's runs with this boat: layouts may differ."""
    means = [float(np.mean([row["ceiling"] for row in rows])) for rows in groups(_on(results, boat), "low").values()]
    return [min(means), max(means)]


def _on(results: Rows, boat: str) -> Rows:
    return [row for row in results if row["boat"] == boat]


def _ceiling_text(results: Rows, boat: str) -> str:
    return " to ".join(dict.fromkeys(f"{ceiling:.3f}" for ceiling in ceilings(results, boat)))


def brief_table(rows: Rows, results: Rows) -> str:
    """Return one line for each learner, for the project's front page."""
    lines = [
        "| | score, congruent controller | score, incongruent controller | seeds | presses | CPU |",
        "|---|---|---|---|---|---|",
    ]
    for (low,), boats in groups(rows, "learner").items():
        scores = {row["boat"]: row["spread"] for row in boats}
        cells = " | ".join(scores.get(boat, "") for boat in BOATS)
        presses = np.mean([row["presses"] for row in boats])
        cpu_s = np.mean([row["cpu_s"] for row in boats])
        seeds = " and ".join(dict.fromkeys(str(row["seeds"]) for row in boats))
        lines.append(f"| {low} | {cells} | {seeds} | {presses:,.0f} | {cpu_s:.0f} s |")
    human = " | ".join(f"{HUMAN[boat]['score']:.3f}" for boat in BOATS)
    lines.append(f"| people, mean | {human} | | {HUMAN_PRESSES} | |")
    lines.append(f"| ceiling | {' | '.join(_ceiling_text(results, boat) for boat in BOATS)} | | | |")
    lines.append(f"| random presses | {RANDOM['score']:.3f} | {RANDOM['score']:.3f} | | | |")
    return "\n".join(lines)


def table(rows: Rows, results: Rows) -> str:
    """Return the lines of the learners, then those of people, the ceiling and random presses.

    From ten seeds on, the interquartile mean and its interval follow the score.
    """
    lines = [
        "| | controller | seeds | score | below the ceiling | above the next best (95 %) | human-normalised score "
        "| success | presses | CPU | the paper's |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        middle = f"; {row['interquartile_mean']}" if row["interquartile_mean"] else ""
        lines.append(
            f"| {row['learner']} | {row['boat']} | {row['seeds']} | {row['spread']}{middle} | "
            f"{row['below_ceiling']:.3f} | {row['above_next']} | {row['human_normalised']:.3f} | "
            f"{row['success']:.1%} | {row['presses']:,.0f} | {row['cpu_s']:.0f} s | {row['paper']} |"
        )
    for boat, paper in zip(BOATS, PAPER_HUMAN, strict=True):
        human = HUMAN[boat]
        lines.append(
            f"| people | {boat} | | {human['score']:.3f} | | | 1 | {human['success']:.1%} | {HUMAN_PRESSES} | | "
            f"{paper} (*) |"
        )
    for boat in BOATS:
        lines.append(f"| ceiling | {boat} | | {_ceiling_text(results, boat)} | | | | 100.0% | | | |")
    lines.append(f"| random | both | | {RANDOM['score']:.3f} | | | 0 | {RANDOM['success']:.1%} | | | |")
    return "\n".join(lines)


def reward_table(results: Rows) -> str:
    """Return a line for each learner with its scores after training with each reward, and the difference.

    Sparse rewards have earlier seeds, so shaped ones are compared with the same seeds on the same layouts.
    """
    results = [row for row in results if row["seed"] in EARLIER_SEEDS]
    columns = [f"{boat}, {what}" for boat in BOATS for what in (*REWARDS, "sparse less shaped (95 %)")]
    lines = []
    for low in LEARNERS:
        if not any(row["low"] == low and row["reward"] == "sparse" for row in results):
            continue
        cells = []
        for boat in BOATS:
            shaped, sparse = (
                [row["score"] for row in _of(results, low, boat) if row["reward"] == reward] for reward in REWARDS
            )
            cells += [spread(scores) if scores else "" for scores in (shaped, sparse)]
            cells.append(str(difference(sparse, shaped)) if shaped and sparse else "")
        lines.append([low, *cells])
    return markdown_table(f"learner | {' | '.join(columns)}", lines)


def efficiency_table(efficiency: Rows, results: Rows) -> str:
    """Return a line for each learner: presses to the human score, and full-length scores over both controllers."""
    lines = []
    for low in LEARNERS:
        of_learner = [row for row in efficiency if row["low"] == low]
        if not of_learner:
            continue
        cells = []
        for boat in BOATS:
            runs = groups(_of(efficiency, low, boat), "seed").values()
            cells.append(_range([_first_at_human_score(rows) for rows in runs], "frames"))
        runs = groups(of_learner, "boat", "seed").values()
        cells.append(_range([_first_at_human_score(rows) for rows in runs], "wall_s"))
        by_seed = groups([row for row in results if row["low"] == low], "seed").values()
        normalised = [np.mean([human_normalised(row["score"], row["boat"]) for row in rows]) for rows in by_seed]
        lines.append([low, *cells, spread(normalised)])
    head = (
        "learner | presses to 1.97, congruent | incongruent | wall seconds, both "
        "| human-normalised score: full-length runs, both controllers"
    )
    return markdown_table(head, lines)


def budget_table(curves: Rows) -> str:
    """Return a line for each learner and boat with its scores after equal numbers of presses.

    A cell is empty if some run has no evaluation near the number of presses, or has ended before.
    """
    lines = []
    for low, boat in itertools.product(LEARNERS, BOATS):
        runs = groups(_of(curves, low, boat), "seed").values()
        cells = [[_score_after(run, budget) for run in runs] for budget in BUDGETS]
        texts = ["" if None in scores else spread(scores) for scores in cells]
        lines.append([low, boat, *texts])
    return markdown_table(f"score after | controller | {' | '.join(f'{each:,} presses' for each in BUDGETS)}", lines)


def _score_after(run: Rows, budget: int) -> float | None:
    """Return the score of a run's evaluation that is nearest to a number of presses; None if none is near."""
    nearest = min(run, key=lambda row: abs(row["frames"] - budget))
    return nearest["eval/score"] if budget / NEAR <= nearest["frames"] <= budget * NEAR else None


def _first_at_human_score(rows: Rows) -> dict[str, Any] | None:
    """Return a run's first evaluation at the mean human score or above."""
    return next((row for row in rows if row["eval/score"] >= HUMAN["chosen"]["score"]), None)


def _range(rows: Sequence[dict[str, Any] | None], column: str) -> str:
    """Return the smallest and the largest value, and the number of runs with a value if some have None."""
    values = [row[column] for row in rows if row is not None]
    share = f"{len(values)} of {len(rows)} seeds"
    if not values:
        return share
    lowest, highest = f"{min(values):,.0f}", f"{max(values):,.0f}"
    text = lowest if lowest == highest else f"{lowest} to {highest}"
    return text if len(values) == len(rows) else f"{text} ({share})"


def draw_curves(curves: Rows, results: Rows, path: Path) -> None:
    """Draw score and success against presses, a row for each controller: mean over seeds and one standard deviation."""
    figure = Figure(figsize=(11.5, 7.6), layout="constrained")
    for boat, row in zip(BOATS, figure.subplots(2, 2, sharex=True), strict=True):
        for metric, axes in zip(PANELS, row, strict=True):
            _draw_learners(axes, curves, boat, metric)
            _draw_reference(axes, "ceiling", max(ceilings(results, boat)) if metric == "score" else 1.0, INK, "-")
            _draw_reference(axes, "people", HUMAN[boat][metric], HUMAN_COLOUR, "--")
            _draw_reference(axes, "random", RANDOM[metric], FAINT, ":")
            axes.set_title(f"{boat} boat", loc="left", fontweight="bold", fontsize=10)
        row[0].legend(loc="lower right", bbox_to_anchor=(1.0, 0.18), fontsize=8, frameon=False, ncols=2)
    figure.savefig(path, dpi=130)


def _draw_learners(axes: Axes, curves: Rows, boat: str, metric: str) -> None:
    for low in LEARNERS:
        rows = _of(curves, low, boat)
        if not rows:
            continue
        x, mean, deviation = curve(rows, "frames", f"eval/{metric}")
        late = x > 0  # the axis is logarithmic
        x, mean, deviation = x[late], mean[late], deviation[late]
        marker = "o" if len(x) < 5 else None
        axes.plot(x, mean, color=LEARNER_COLOURS[low], linewidth=1.8, label=low, marker=marker, markersize=4)
        upper = mean + deviation if metric == "score" else np.minimum(mean + deviation, 1.0)
        axes.fill_between(x, mean - deviation, upper, color=LEARNER_COLOURS[low], alpha=0.18, linewidth=0)
    label, bottom, top = PANELS[metric]
    axes.set(xscale="log", xlabel="presses", ylabel=label, ylim=(bottom, top))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.spines[["top", "right"]].set_visible(False)
    if metric == "success":
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))


def _draw_reference(axes: Axes, name: str, height: float, colour: str, style: str) -> None:
    axes.axhline(height, color=colour, linestyle=style, linewidth=1.0, zorder=1)
    text = f"{name} {height:.2f}" if axes.get_ylim()[1] > 2 else f"{name} {height:.0%}"
    axes.annotate(
        text,
        (0.995, height),
        xytext=(0, 2),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        fontsize=8,
        ha="right",
    )


def draw_efficiency(efficiency: Rows, path: Path) -> None:
    """Draw score against presses up to the human mean, a line for each seed, with people's own learning beside them."""
    figure = Figure(figsize=(12.5, 4.4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for boat, axes in zip(BOATS, panels, strict=True):
        for low in LEARNERS:
            runs = groups(_of(efficiency, low, boat), "seed").values()
            for number, rows in enumerate(runs):
                _draw_run(axes, rows, LEARNER_COLOURS[low], low if number == 0 else None)
        x, y = human_by_block(boat)
        axes.plot(x, y, "s--", color=HUMAN_COLOUR, markersize=4, label="a person, 60 episodes a square")
        axes.set(xscale="log", xlabel="presses", xlim=(80, 1e7), ylim=(-1.1, 2.6))
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_title(f"{boat} boat", loc="left", fontweight="bold", fontsize=10)
        _draw_reference(axes, "people's mean", HUMAN["chosen"]["score"], HUMAN_COLOUR, "--")
        _draw_reference(axes, "random", RANDOM["score"], FAINT, ":")
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 0.06), fontsize=8, frameon=False)
    panels[0].set_ylabel("score, greedy")
    figure.savefig(path, dpi=130)


def _draw_run(axes: Axes, rows: Rows, colour: str, label: str | None) -> None:
    """Draw a run's scores, with a dot where it reaches the human score."""
    late = [row for row in rows if row["frames"] > 0]  # the axis is logarithmic
    x = [row["frames"] for row in late]
    y = [row["eval/score"] for row in late]
    axes.plot(x, y, color=colour, linewidth=1.0, alpha=0.6)
    reached = _first_at_human_score(rows)
    end = [] if reached is None else [(reached["frames"], reached["eval/score"])]
    axes.plot([frames for frames, _ in end], [score for _, score in end], "o", color=colour, markersize=5, label=label)


def human_by_block(boat: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a person's presses up to the middle of each block of episodes, and the mean score in it with this boat."""
    blocks = read_csv(HUMAN_BLOCKS)
    num_presses = np.array([row["presses"] for row in blocks if row["controller"] == BOTH_BOATS]) * BLOCK_EPISODES
    scores = np.array([row["score"] for row in blocks if row["controller"] == CONTROLLERS.index(boat)])
    return num_presses.cumsum() - num_presses / 2, scores


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        new = gathered(folders, gather, settings=OF_PROBLEM, **OF_STUDY)
        add_to_tables(HERE, new, (*CELL, "seed"), steps="presses")
    tables = {name: standing_rows(HERE / f"{name}.csv") for name in TABLES}
    stored = read_csv(HERE / "results.csv")
    shaped, curves = ([row for row in tables[name] if row["reward"] == "shaped"] for name in ("results", "curves"))
    rows = summarise(shaped)
    write_tables(HERE, {"table1": rows})
    draw_curves(curves, shaped, HERE / "figure2.png")
    draw_efficiency(tables["efficiency"], HERE / "efficiency.png")
    print(
        brief_table(rows, shaped),
        table(rows, shaped),
        efficiency_table(tables["efficiency"], shaped),
        reward_table(stored),
        budget_table(curves),
        sep="\n\n",
    )


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
