"""Train H-PPO with one controller with each collector, one run after another.

python experiments/collectors/study.py run   makes eighteen runs, writes results.csv, then tabulates
python experiments/collectors/study.py       tabulates the stored results.csv
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from experiments.study_tables import Rows, groups, markdown_table, mean_of, read_csv, write_tables
from hpamdp.analysis.statistics import spread
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
RUN = HERE.parents[1] / "run.py"
COLLECTORS = ("single", "multi", "ray")
SEEDS = (0, 1, 2)
COMMON = ["high=none", "low=hppo", "eval.every=0", "eval.layouts=1000", "log_every=0"]
TASKS = {
    "cheap steps": ["env.controller=congruent", "total_frames=300000"],
    # The same boat as a Gymnasium environment. Python steps its copies one after another.
    "expensive steps": [
        "env=gymnasium",
        "env.id=hpamdp/BoatDock-v0",
        "env.kwargs={controller:congruent}",
        "env.max_steps=100",
        "num_envs=256",
        "steps_per_batch=16",
        "total_frames=16384",
        "eval.layouts=100",
    ],
}


def train(task: str, collector: str, seed: int) -> dict[str, float | str]:
    """Make a run and return its final score, its speed and its cost."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = [*COMMON, *TASKS[task], f"collector={collector}", f"seed={seed}", f"hydra.run.dir={folder}"]
        started = time.perf_counter()
        subprocess.run(
            [sys.executable, str(RUN), *overrides],
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        whole_s = time.perf_counter() - started
        summary = json.loads((Path(folder) / "summary.json").read_text())
    return {
        "task": task,
        "collector": collector,
        "seed": seed,
        "frames": summary["frames"],
        "score": round(summary["score"], 4),
        "frames_per_s": round(summary["frames"] / summary["wall_s"]),
        "wall_s": round(summary["wall_s"], 1),
        "cpu_s": round(summary["cpu_s"], 1),
        "whole_s": round(whole_s, 1),
    }


def run_all() -> Rows:
    """Return a row for each run. Collectors and seeds alternate, so that other load on the machine slows all alike."""
    rows: Rows = []
    for task in TASKS:
        for seed in SEEDS:
            for collector in COLLECTORS:
                rows.append(train(task, collector, seed))
                print(rows[-1], flush=True)
    return rows


def table(rows: Rows) -> str:
    """Return a line for each task and collector: mean ± standard deviation of the score over seeds, and other means."""
    lines = []
    for (task, collector), runs in groups(rows, "task", "collector").items():
        seconds = [f"{mean_of(runs, column):.1f}" for column in ("wall_s", "cpu_s", "whole_s")]
        score, speed = spread([run["score"] for run in runs]), f"{mean_of(runs, 'frames_per_s'):,.0f}"
        lines.append([task, f"`{collector}`", score, speed, *seconds])
    return markdown_table("| collector | score | frames/s | wall s | CPU s | whole command, s", lines)


def main(words: Sequence[str]) -> None:
    """Run if asked, tabulate."""
    if words == ["run"]:
        write_tables(HERE, {"results": run_all()})
    elif words:
        raise SystemExit(f"{' '.join(words)}: the only argument is run; without it the stored results.csv is tabulated")
    print(table(read_csv(HERE / "results.csv")))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
