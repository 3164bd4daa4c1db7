"""Train H-PPO on one boat with each way of collecting, one run after another.

python experiments/collectors/collectors.py      nine runs; writes results.csv, prints the table
"""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
RUN = HERE.parents[1] / "run.py"
COLLECTORS = ("single", "multi", "ray")
SEEDS = (0, 1, 2)
TASK = ["high=none", "low=hppo", "env.controller=congruent", "total_frames=300000", "eval.every=0", "log_every=0"]


def train(collector: str, seed: int) -> dict[str, float | str]:
    """Return the final score of a run, its speed and what it cost."""
    with tempfile.TemporaryDirectory() as folder:
        before = time.perf_counter()
        command = [sys.executable, str(RUN), *TASK, f"collector={collector}", f"seed={seed}", f"hydra.run.dir={folder}"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        whole_s = time.perf_counter() - before
        summary = json.loads((Path(folder) / "summary.json").read_text())
    return {
        "collector": collector,
        "seed": seed,
        "frames": summary["frames"],
        "score": round(summary["score"], 4),
        "success": summary["success"],
        "frames_per_s": round(summary["frames"] / summary["wall_s"]),
        "wall_s": round(summary["wall_s"], 1),
        "cpu_s": round(summary["cpu_s"], 1),
        "whole_s": round(whole_s, 1),
    }


def main() -> None:
    """Run, write and print everything; seeds take turns, so that a busy machine is busy for all alike."""
    rows = []
    for seed in SEEDS:
        for collector in COLLECTORS:
            rows.append(train(collector, seed))
            print(rows[-1], flush=True)
    with (HERE / "results.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    print("| collector | score | frames/s | wall s | CPU s | whole command, s |\n|---|---|---|---|---|---|")
    for collector in COLLECTORS:
        own = [row for row in rows if row["collector"] == collector]
        mean = {name: np.mean([row[name] for row in own]) for name in own[0] if name != "collector"}
        deviation = np.std([row["score"] for row in own], ddof=1)
        print(
            f"| `{collector}` | {mean['score']:.3f} ± {deviation:.3f} | {mean['frames_per_s']:,.0f} "
            f"| {mean['wall_s']:.1f} | {mean['cpu_s']:.1f} | {mean['whole_s']:.1f} |"
        )


if __name__ == "__main__":
    main()
