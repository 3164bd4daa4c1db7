"""Gather the offline learners' runs and the runs that continued from them, then draw and tabulate them.

python experiments/offline/study.py multirun/offline multirun/finetune   reads the runs, writes csv files, then draws
python experiments/offline/study.py planner multirun/planner             reads the runs of the planner, likewise
python experiments/offline/study.py                                      draws and tabulates the stored csv files
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

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
    interval_text,
    markdown_table,
    mean_of,
    read_csv,
)
from hpamdp.analysis.statistics import spread
from hpamdp.env.boatdock.reference import HUMAN
from hpamdp.figure_style import draw_spread
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
HUMAN_SCORE = HUMAN["chosen"]["score"]
COLOURS = {"bc": "#8c8c8c", "iql": "#0072B2", "td3_bc": "#D55E00"}
OUTCOMES = ("success", "too_fast", "out_of_bounds", "out_of_fuel")
OFFLINE, PRETRAINED, SCRATCH = "offline", "pretrained", "scratch"  # start of a run
REST_TO_REST, RECORDED = "rest-to-rest", "recorded"  # form of the data's presses
CASE = ("low", "start", "data", "episodes")
Case: TypeAlias = tuple[str, str, str, str]
# Comparisons of the page: learner, start, presses and episodes of both sides.
COMPARISONS = (
    ("bc: rest-to-rest less recorded", ("bc", OFFLINE, REST_TO_REST, "all"), ("bc", OFFLINE, RECORDED, "all")),
    ("iql: rest-to-rest less recorded", ("iql", OFFLINE, REST_TO_REST, "all"), ("iql", OFFLINE, RECORDED, "all")),
    ("bc: successes less all", ("bc", OFFLINE, REST_TO_REST, "successes"), ("bc", OFFLINE, REST_TO_REST, "all")),
    ("iql less bc", ("iql", OFFLINE, REST_TO_REST, "all"), ("bc", OFFLINE, REST_TO_REST, "all")),
    ("td3_bc less iql", ("td3_bc", OFFLINE, REST_TO_REST, "all"), ("iql", OFFLINE, REST_TO_REST, "all")),
    ("iql: pretrained less scratch", ("iql", PRETRAINED, "none", "all"), ("iql", SCRATCH, "none", "all")),
    ("pretrained: iql less td3_bc", ("iql", PRETRAINED, "none", "all"), ("td3_bc", PRETRAINED, "none", "all")),
)


# Runs of the planner, told apart by whose presses it learned from, the reward and the boats in the data.
PLANNER = "planner"
PLANNER_CELL = ("people", "reward", "boats")
PEOPLE = {"all": "all 40", "worst_20": "the worse half", "one": "one, another one for each seed"}
REWARDS = {"paper": "progress and score", "sparse": "recorded score alone"}


def gather_planner(runs: Sequence[Run]) -> Rows:
    """Return a row for each run of the planner: its score on the whole task and with one boat.

    An agent that chooses between the boats is also scored with one of them held.
    """
    rows: Rows = []
    for run in runs:
        summary, data, env = run.summary, run.config["data"], run.config["env"]
        people = "one" if data["people"] else f"worst_{data['worst_people']}" if data["worst_people"] else "all"
        is_one = env["controller"] == "congruent"
        rows.append(
            {
                "people": people,
                "reward": env["reward"],
                "boats": "congruent" if is_one else "both",
                "seed": summary["seed"],
                "person": ",".join(map(str, data["people"] or ())),
                "updates": summary["frames"],
                "whole_task": "" if is_one else round(summary["score"], 4),
                "one_boat": round(summary["score" if is_one else "score_congruent"], 4),
                "success": round(summary["success"], 4),
                "presses": round(summary["steps"], 4),
                "cpu_s": round(summary["cpu_s"], 1),
            }
        )
    return rows


def planner_table(rows: Rows) -> str:
    """Return the planner's scores by cell, with the median over seeds beside the mean."""
    lines = []
    for (people, reward, boats), runs in groups(rows, *PLANNER_CELL).items():
        cells = []
        for column in ("whole_task", "one_boat"):
            scores = [run[column] for run in runs if run[column] != ""]
            cells += [spread(scores), interval_text(scores, ".2f")] if scores else ["", ""]
        costs = f"{mean_of(runs, 'success'):.1%}", f"{mean_of(runs, 'presses'):.2f}", f"{mean_of(runs, 'cpu_s'):.0f} s"
        lines.append([PEOPLE.get(people, people), REWARDS[reward], boats, len(runs), *cells, *costs])
    head = "people | reward | boats | seeds | whole task | 95 % | one boat | 95 % | success | presses | CPU"
    return markdown_table(head, lines)


def gather(runs: Sequence[Run]) -> tuple[Rows, Rows]:
    """Return a row for each run and a row for each evaluation."""
    results: Rows = []
    curves: Rows = []
    for run in runs:
        summary = run.summary
        evaluations = run.evaluations()
        data, episodes = _data(run)
        name = {
            "low": summary["low"],
            "start": _start(run),
            "data": data,
            "episodes": episodes,
            "seed": summary["seed"],
        }
        reached = first_at(evaluations, "eval/score", HUMAN_SCORE)
        results.append(
            {
                **name,
                "score": round(summary["score"], 4),
                **{outcome: round(summary[outcome], 4) for outcome in OUTCOMES},
                "presses": round(summary["steps"], 4),
                "frames_to_human": "" if reached is None else reached["frames"],
                "cpu_s": round(summary["cpu_s"], 1),
            }
        )
        for row in evaluations:
            curves.append({**name, "frames": row["frames"], "score": round(row["eval/score"], 4)})
    return results, curves


def _start(run: Run) -> str:
    """Return the start of a run: offline, from a trained agent, or from scratch."""
    if run.config["mode"] == "offline":
        return OFFLINE
    return SCRATCH if run.config["low"]["checkpoint"] is None else PRETRAINED


def _data(run: Run) -> tuple[str, str]:
    """Return the form of the presses that a run learned from, and the episodes."""
    if run.config["mode"] != "offline":
        return "none", "all"
    data = REST_TO_REST if run.config["data"]["rest_to_rest"] else RECORDED
    return data, "successes" if run.config["data"]["successes"] else "all"


def table(results: Rows, curves: Rows) -> str:
    """Return the offline learners' scores, then the presses that pre-training saves, then the comparisons."""
    updates = {case: max(row["frames"] for row in rows) for case, rows in groups(curves, *CASE).items()}
    fitted, online = [], []
    for (low, start, data, episodes), runs in groups(results, *CASE).items():
        score = spread([run["score"] for run in runs])
        if start == OFFLINE:
            shares = [f"{mean_of(runs, outcome):.1%}" for outcome in OUTCOMES]
            costs = f"{mean_of(runs, 'presses'):.2f}", f"{mean_of(runs, 'cpu_s'):.0f} s"
            length = f"{updates[low, start, data, episodes]:,.0f}"
            fitted.append([low, data, episodes, length, len(runs), score, *shares, *costs])
        else:
            frames = [run["frames_to_human"] for run in runs]
            online.append([low, start, ", ".join("never" if at == "" else f"{at:,.0f}" for at in frames), score])
    compared = [line for case in COMPARISONS if (line := comparison(*case, curves)) is not None]
    head = (
        "learner | presses as | episodes | updates | seeds | score | success | too fast | out | no fuel | presses | CPU"
    )
    tables = [
        markdown_table(head, fitted),
        markdown_table("learner | start | presses to 1.97, by seed | score at the end", online),
        markdown_table("| after | difference (95 %) | probability of improvement", compared),
    ]
    return "\n\n".join(tables)


def comparison(title: str, better: Case, other: Case, curves: Rows) -> list[object] | None:
    """Return a line with the difference of two cases; None if one has no runs.

    They are compared at the last evaluation that all their runs have, after as many updates or presses of their own.
    """
    of_case = groups(curves, *CASE)
    if better not in of_case or other not in of_case:
        return None
    runs = [run for case in (better, other) for run in groups(of_case[case], "seed").values()]
    end = max(set.intersection(*({row["frames"] for row in run} for run in runs)))
    scores = ([row["score"] for row in of_case[case] if row["frames"] == end] for case in (better, other))
    found = difference(*scores)
    unit = "updates" if better[1] == OFFLINE else "presses"
    return [title, f"{end:,.0f} {unit}", found, f"{found.improvement:.2f}"]


def draw(curves: Rows, path: Path) -> None:
    """Draw the scores against updates from the data set, and against the agent's own presses."""
    figure = Figure(figsize=(12.0, 4.0), layout="constrained")
    offline, online = figure.subplots(1, 2, sharey=True)
    cases = groups(curves, "start", "data", "episodes", "low").items()
    for (start, data, episodes, low), rows in cases:
        if start != OFFLINE:
            _draw_curve(online, rows, f"{low}, {start}", COLOURS[low], "-" if start == PRETRAINED else ":")
        elif data == REST_TO_REST and episodes == "all":
            _draw_curve(offline, rows, low, COLOURS[low], "-")
    for axes, x, title in ((offline, "updates", "from people's presses alone"), (online, "presses", "then on its own")):
        axes.axhline(HUMAN_SCORE, color="#D98200", linestyle="--", linewidth=1.0)
        axes.set_title(title, loc="left", fontsize=10, fontweight="bold")
        axes.set_xlabel(x)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(fontsize=8, frameon=False, loc="lower right")
    offline.set_ylabel("score, greedy, 1,000 layouts")
    offline.annotate("people 1.97", (0.01, HUMAN_SCORE + 0.06), xycoords=("axes fraction", "data"), fontsize=8)
    figure.savefig(path, dpi=130)


def _draw_curve(axes: Axes, rows: Rows, label: str, colour: str, style: str) -> None:
    draw_spread(axes, *curve(rows, "frames", "score"), style, color=colour, linewidth=1.6, label=label)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders[:1] == [PLANNER]:
        rows = gathered(
            folders[1:],
            gather_planner,
            settings={"boatdock.controller": ("choose", "congruent"), "boatdock.reward": ("paper", "sparse")},
            modes=("offline",),
            env=("boatdock",),
            low=("pets",),
        )
        add_to_tables(HERE, {PLANNER: rows}, (*PLANNER_CELL, "seed"), steps="updates")
    elif folders:
        results, curves = gathered(
            folders, gather, modes=("train", "offline"), env=("boatdock",), low=COLOURS, high=("human",)
        )
        names = ("low", "start", "data", "episodes", "seed")
        add_to_tables(HERE, {"results": results, "curves": curves}, names, sorts=False)
    results, curves, planner = (read_csv(HERE / f"{name}.csv") for name in ("results", "curves", PLANNER))
    draw(curves, HERE / "curves.png")
    print(table(results, curves))
    print(f"\n{planner_table(planner)}")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
