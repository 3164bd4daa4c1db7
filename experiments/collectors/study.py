"""Train H-PPO on one boat with each way of collecting, one run after another.

python experiments/collectors/study.py run   eighteen runs; writes results.csv, then tabulates
python experiments/collectors/study.py       tabulates what results.csv holds
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hpamdp.analysis.study import Rows, groups, read_csv, spread, write_tables

HERE = Path(__file__).resolve().parent
RUN = HERE.parents[1] / "run.py"
COLLECTORS = ("single", "multi", "ray")
SEEDS = (0, 1, 2)
COMMON = ["high=none", "low=hppo", "eval.every=0", "log_every=0"]
TASKS = {
    "cheap steps": ["env.controller=congruent", "total_frames=300000"],
    # The same boat, each copy stepped by Python in turn.
    "dear steps": [
        "env=gymnasium",
        "env.id=hpamdp/BoatDock-v0",
        "env.kwargs={controller:congruent}",
        "env.max_steps=100",
        "num_envs=256",
        "total_frames=16384",
        "eval.layouts=100",
    ],
}


def train(task: str, collector: str, seed: int) -> dict[str, float | str]:
    """Return the final score of a run, its speed and what it cost."""
    with tempfile.TemporaryDirectory() as folder:
        before = time.perf_counter()
        words = [*COMMON, *TASKS[task], f"collector={collector}", f"seed={seed}", f"hydra.run.dir={folder}"]
        command = [sys.executable, str(RUN), *words]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        whole_s = time.perf_counter() - before
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
    """Return a row a run; ways and seeds take turns, so that a busy machine is busy for all alike."""
    rows = []
    for task in TASKS:
        for seed in SEEDS:
            for collector in COLLECTORS:
                rows.append(train(task, collector, seed))
                print(rows[-1], flush=True)
    return rows


def table(rows: Rows) -> str:
    """Return a line a task and collector: mean ± standard deviation over seeds of the score, means of the rest."""
    lines = ["| | collector | score | frames/s | wall s | CPU s | whole command, s |", "|---|---|---|---|---|---|---|"]
    for (task, collector), of in groups(rows, "task", "collector").items():
        speed, wall, cpu, whole = (
            np.mean([row[key] for row in of]) for key in ("frames_per_s", "wall_s", "cpu_s", "whole_s")
        )
        score = spread([row["score"] for row in of])
        lines.append(f"| {task} | `{collector}` | {score} | {speed:,.0f} | {wall:.1f} | {cpu:.1f} | {whole:.1f} |")
    return "\n".join(lines)


def main(words: Sequence[str]) -> None:
    """Run if asked, tabulate."""
    if words == ["run"]:
        write_tables(HERE, {"results": run_all()})
    elif words:
        raise SystemExit(f"{' '.join(words)}: the only word is run; without it what results.csv holds is tabulated")
    print(table(read_csv(HERE / "results.csv")))


if __name__ == "__main__":
    main(sys.argv[1:])
