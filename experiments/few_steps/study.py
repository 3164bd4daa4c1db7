"""Draw and tabulate the presses that PETS needs to play as well as people, beside people's own learning.

python experiments/few_steps/study.py FOLDER...    gathers the runs of experiment=few_steps in these folders into
                                                   curves.csv, the long ones into long.csv, those of other learners
                                                   into augment.csv, then draws and tabulates
python experiments/few_steps/study.py              draws and tabulates the stored csv files
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.study_tables import (
    Rows,
    Run,
    first_at,
    gathered,
    groups,
    markdown_table,
    mean_of,
    merged_tables,
    read_csv,
    write_tables,
)
from hpamdp.analysis.statistics import spread
from hpamdp.env.boatdock.harbour import CONTROLLERS
from hpamdp.env.boatdock.reference import BEST_PERSON, HUMAN
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
# Settings of the problem that may differ from its own; those with None tell rows apart.
OF_PROBLEM = {"boatdock.controller": None, "boatdock.reward": None}
HUMAN_BLOCKS = HERE.parent / "human" / "blocks.csv"
BOTH_BOATS = -1  # in the column `controller` of these
BLOCK_EPISODES = 60
LONG = 2000  # least presses of a long run
BOATS = ("congruent", "incongruent")
TASKS = {"congruent": "congruent", "incongruent": "incongruent", "chosen": "chosen by the agent"}
HUMAN_SCORE = HUMAN["chosen"]["score"]
BEST_SCORE = BEST_PERSON["score"]
DECLARED = ("auto", "shaped")  # augment and reward by default
SETTINGS = {
    DECLARED: "symmetry declared",
    ("auto", "sparse"): "symmetry declared, sparse reward",
    ("False", "shaped"): "symmetry not declared",
}
# Settings that ablations change, their default values, and labels.
ABLATED = {"num_members": (5,), "posterior_sampling": ("auto", True), "updates_per_step": (10.0,), "horizon": (2,)}
VARIANTS = {
    "": "as above",
    "posterior_sampling=False": "explores by the mean of the members",
    "num_members=1": "one member",
    "updates_per_step=3.0": "3 updates for each press, not 10",
    "horizon=1": "plans of one press",
    "horizon=3": "plans of three presses",
}
ABLATION_SEEDS = (0, 1, 2)
FIGURES = "seeds | presses to 1.97, median | slowest | to 3.02, median | score after 256 | after 384"
# Columns that name a run, in each table.
RUN = {
    "curves": ("augment", "seed", "boat", "reward", "variant"),
    "long": ("augment", "seed", "boat"),
    "augment": ("learner", "augment", "seed"),
}
COLUMNS = {"frames": "presses", "eval/score": "score", "eval/success": "success", "wall_s": "wall_s"}


def gather(runs: Sequence[Run]) -> dict[str, Rows]:
    """Return a row of `curves` or `long` for each evaluation of PETS, and one of `augment` for each other run."""
    curves: Rows = []
    long: Rows = []
    augment: Rows = []
    for run in runs:
        evaluations = [{short: round(row[column], 4) for column, short in COLUMNS.items()} for row in run.evaluations()]
        name = {"augment": str(run.config["low"]["augment"]), "seed": run.summary["seed"]}
        if run.summary["low"] != "pets":
            presses = presses_to(HUMAN_SCORE, evaluations)
            augment.append(
                {"learner": run.summary["low"], **name, "presses": presses, "cpu_s": round(run.summary["cpu_s"], 1)}
            )
            continue
        if run.summary["frames"] >= LONG:
            name |= {"boat": run.summary["controller"], "cpu_s": round(run.summary["cpu_s"], 1)}
            long += [name | row for row in evaluations]
            continue
        name |= {
            "boat": run.summary["controller"],
            "reward": "sparse" if run.config["env"]["reward"] == "sparse" else "shaped",
            "variant": variant(run),
        }
        curves += [name | row for row in evaluations]
    return {"curves": curves, "long": long, "augment": augment}


def variant(run: Run) -> str:
    """Return the settings that an ablation changed."""
    values = {name: run.config["low"][name] for name in ABLATED}
    return " ".join(f"{name}={value}" for name, value in values.items() if value not in ABLATED[name])


def presses_to(score: float, evaluations: Rows) -> float:
    """Return a run's presses at its first evaluation with at least this score; infinity if there is none."""
    reached = first_at(evaluations, "score", score)
    return float("inf") if reached is None else reached["presses"]


def _presses(counts: Sequence[float], statistic: str) -> str:
    """Return the median or the largest number of presses as text, with the number of runs that succeeded."""
    value = float(np.median(counts)) if statistic == "median" else max(counts)
    reached = sum(np.isfinite(counts))
    share = "" if reached == len(counts) else f" ({reached} of {len(counts)} seeds)"
    return f"{value:,.0f}{share}" if np.isfinite(value) else f"not reached{share}"


def runs_of(curves: Rows, augment: str, reward: str, boat: str) -> Rows:
    """Return the rows of a setting with a boat."""
    return [row for row in curves if (row["augment"], row["reward"], row["boat"]) == (augment, reward, boat)]


def table(curves: Rows) -> str:
    """Return a line for each setting and boat."""
    lines = []
    for (augment, reward), label in SETTINGS.items():
        for boat, task in TASKS.items():
            rows = runs_of(curves, augment, reward, boat)
            if rows:
                lines.append([label, task, *_figures(rows)])
    return markdown_table(f"| controller | {FIGURES}", lines)


def ablation_table(curves: Rows) -> str:
    """Return a line for each variant with the congruent controller, with the seeds that all variants have."""
    rows = [row for row in runs_of(curves, *DECLARED, "congruent") if row["seed"] in ABLATION_SEEDS]
    cells = {name: of_name for (name,), of_name in groups(rows, "variant").items()}
    lines = [[label, *_figures(cells[name])] for name, label in VARIANTS.items() if name in cells]
    return markdown_table(f"| {FIGURES}", lines)


def _figures(rows: Rows) -> list[object]:
    """Return the number of runs, their presses to people's scores, and their scores after 256 and 384 presses."""
    runs = list(groups(rows, "seed").values())
    human = [presses_to(HUMAN_SCORE, run) for run in runs]
    best = [presses_to(BEST_SCORE, run) for run in runs]
    after = [[row["score"] for row in rows if row["presses"] == presses] for presses in (256, 384)]
    scores = [spread(score) if len(score) == len(runs) else "" for score in after]
    return [len(runs), _presses(human, "median"), _presses(human, "slowest"), _presses(best, "median"), *scores]


def long_table(long: Rows) -> str:
    """Return a line for each boat: the scores of long runs."""
    presses = sorted({row["presses"] for row in long if row["presses"] > 0})
    lines = []
    for boat, task in TASKS.items():
        rows = [row for row in long if row["boat"] == boat]
        if rows:
            scores = [spread([row["score"] for row in rows if row["presses"] == number]) for number in presses]
            lines.append([task, len(groups(rows, "seed")), *scores, f"{mean_of(rows, 'cpu_s'):.0f} s"])
    lengths = " | ".join(f"{number:,.0f} presses" for number in presses)
    return markdown_table(f"controller | seeds | {lengths} | CPU of a run", lines)


def augment_table(augment: Rows) -> str:
    """Return a line for each learner: presses to people's score without and with mapped steps."""
    lines = []
    for (learner,), rows in groups(augment, "learner").items():
        cells = {name: of_name for (name,), of_name in groups(rows, "augment").items()}
        without, mapped = cells.get("False", []), cells.get("True", [])
        presses = [", ".join(f"{row['presses']:,.0f}" for row in of_name) for of_name in (without, mapped)]
        cpu = f"{mean_of(mapped, 'cpu_s'):.0f} s" if mapped else ""
        lines.append([learner, max(len(without), len(mapped)), *presses, cpu])
    return markdown_table("| seeds | without | `low.augment=true` | CPU of a run with it", lines)


def human_by_block(boat: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a person's presses up to the middle of each block of episodes, and the mean score in it with this boat."""
    blocks = read_csv(HUMAN_BLOCKS)
    presses = np.array([row["presses"] for row in blocks if row["controller"] == BOTH_BOATS]) * BLOCK_EPISODES
    scores = np.array([row["score"] for row in blocks if row["controller"] == CONTROLLERS.index(boat)])
    return presses.cumsum() - presses / 2, scores


def draw(curves: Rows, path: Path) -> None:
    """Draw score against presses, a line for each seed, with people's own learning beside them."""
    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    for boat, axes in zip(BOATS, figure.subplots(1, 2, sharey=True), strict=True):
        for number, run in enumerate(groups(runs_of(curves, *DECLARED, boat), "seed").values()):
            x, y = [row["presses"] for row in run], [row["score"] for row in run]
            axes.plot(x, y, color="#56B4E9", linewidth=1.2, label=None if number else "PETS, a line for each seed")
        axes.plot(*human_by_block(boat), "s--", color="#D98200", markersize=4, label="a person, 60 episodes a square")
        for height, name in ((HUMAN_SCORE, "people's mean"), (BEST_SCORE, "the best person")):
            axes.axhline(height, color="#8c8c8c", linestyle=":", linewidth=1.0)
            axes.annotate(f"{name} {height:.2f}", (1180, height), xytext=(0, 2), textcoords="offset points", ha="right")
        axes.set(xlabel="presses", xlim=(0, 1200), ylim=(-1.1, 3.7))
        axes.set_title(f"{boat} boat", loc="left", fontweight="bold", fontsize=10)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(loc="lower right", fontsize=8, frameon=False)
        axes.set_ylabel(f"score (people: {HUMAN[boat]['score']:.2f} with this boat)")
    figure.savefig(path, dpi=130)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        new = gathered(folders, gather, settings=OF_PROBLEM, env=("boatdock",))
        merged = {}
        for name in ("curves", "long"):
            if new[name]:
                merged |= merged_tables(
                    HERE, {name: new[name]}, RUN[name], steps="presses", of_evaluations=True, sorts=False
                )
        if new["augment"]:  # whose runs end at people's score
            merged |= merged_tables(HERE, {"augment": new["augment"]}, RUN["augment"], lengths_differ=True, sorts=False)
        write_tables(HERE, merged)
    curves = read_csv(HERE / "curves.csv")
    plain = [row for row in curves if not row["variant"]]
    draw(plain, HERE / "curves.png")
    long, augment = (read_csv(HERE / f"{name}.csv") for name in ("long", "augment"))
    print(table(plain), ablation_table(curves), long_table(long), augment_table(augment), sep="\n\n")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
