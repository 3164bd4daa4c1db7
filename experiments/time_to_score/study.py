"""Measure the CPU time from a cold start to a score.

python experiments/time_to_score/study.py run PLAYER SEED...   adds rows to results.csv, one process for each seed
python experiments/time_to_score/study.py                      tabulates results.csv

`PLAYERS` lists the players.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import hpamdp
from experiments.own_problems.protocol import cpu_seconds
from experiments.study_tables import Rows, groups, markdown_table, read_csv, write_tables
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
BOAT = {"env": "boatdock", "env.controller": "congruent", "high": None}
PEOPLE, BOAT_GOAL, WHOLE_GOAL = 1.97, 3.3, 3.5
# Settings, the scores to reach and the largest number of steps; all else is the default for the problem.
PLAYERS: dict[str, tuple[dict[str, Any], tuple[float, ...], int]] = {
    "one boat, hppo": ({**BOAT, "low": "hppo", "eval.every": 40_000}, (PEOPLE, BOAT_GOAL), 4_000_000),
    "one boat, hsac": ({**BOAT, "low": "hsac", "eval.every": 4_000}, (PEOPLE, BOAT_GOAL), 200_000),
    "one boat, pdqn": ({**BOAT, "low": "pdqn", "eval.every": 10_000}, (PEOPLE, BOAT_GOAL), 200_000),
    "one boat, hyar": ({**BOAT, "low": "hyar", "eval.every": 10_000}, (PEOPLE, BOAT_GOAL), 120_000),
    "one boat, dlpa": ({**BOAT, "low": "dlpa", "eval.every": 1_000}, (PEOPLE, BOAT_GOAL), 20_000),
    "one boat, pets": ({**BOAT, "low": "pets", "eval.every": 32}, (PEOPLE, BOAT_GOAL), 1_024),
    "whole task, meta_critic hppo": (
        {"env": "boatdock", "high": "meta_critic", "low": "hppo", "eval.every": 40_000}, (PEOPLE, WHOLE_GOAL), 4_000_000
    ),
    "whole task, value pets": (
        {"env": "boatdock", "high": "value", "low": "pets", "eval.every": 32}, (PEOPLE, WHOLE_GOAL), 1_024
    ),
    "platform, hppo": ({"env": "platform", "low": "hppo", "eval.every": 4_000}, (0.997,), 400_000),
    "platform, pdqn": ({"env": "platform", "low": "pdqn", "eval.every": 4_000}, (0.997,), 80_000),
    "platform, hyar": ({"env": "platform", "low": "hyar", "eval.every": 4_000}, (0.997,), 80_000),
    "goal, pdqn": ({"env": "goal", "low": "pdqn", "eval.every": 10_000}, (0.809,), 400_000),
    "catch_point, pets": ({"env": "catch_point", "low": "pets", "eval.every": 250}, (0.938,), 4_000),
    "catch_point, pdqn": ({"env": "catch_point", "low": "pdqn", "eval.every": 10_000}, (0.938,), 200_000),
    "catch_point, hppo": ({"env": "catch_point", "low": "hppo", "eval.every": 40_000}, (0.938,), 1_000_000),
    "hard_move, pets": ({"env": "hard_move", "low": "pets", "eval.every": 250}, (0.942,), 4_000),
    "hard_move, pdqn": ({"env": "hard_move", "low": "pdqn", "eval.every": 10_000}, (0.942,), 100_000),
    "hard_move, hppo": ({"env": "hard_move", "low": "hppo", "eval.every": 20_000}, (0.942,), 1_000_000),
}  # fmt: skip


class Crossings(hpamdp.Callback):
    """Note when an evaluation first reaches each score, without the time of evaluations.

    Args:
        goals: the scores, rising. Training ends at the last one.
        metric: what an evaluation is compared by.
    """

    def __init__(self, goals: Sequence[float], metric: str) -> None:
        self.left = [*goals]
        self.metric = metric
        self.found: list[dict[str, Any]] = []
        self._evaluations = 0.0

    def on_start(self, trainer: Any) -> None:
        """Note the end of the start."""
        self.start_s = self._before = cpu_seconds()

    def on_batch(self, trainer: Any) -> None:
        """Note when an evaluation may begin."""
        self._before = cpu_seconds()

    def on_evaluation(self, trainer: Any, row: Mapping[str, float]) -> None:
        """Compare the score with the goals."""
        seconds = self._before - self._evaluations
        self._evaluations += cpu_seconds() - self._before
        while self.left and row[self.metric] >= self.left[0]:
            goal = self.left.pop(0)
            self.found.append({"goal": goal, "cpu_s": round(seconds, 1), "steps": int(row["frames"])})
        if not self.left:
            trainer.stop("the score is reached")


def train(player: str, seed: int) -> Rows:
    """Train until the scores are reached; return a row for each, with the largest number of steps if it is not."""
    settings, goals, most = PLAYERS[player]
    problem = settings["env"]
    crossings = Crossings(goals, "eval/score" if problem in ("boatdock", "platform") else "eval/success")
    given = {"high": None, **settings, "total_frames": most, "eval.layouts": 250}
    hpamdp.train(given.pop("env"), seed=seed, progress=False, film=False, callbacks=[crossings], **given)
    shared = {"player": player, "seed": seed, "start_s": round(crossings.start_s, 1)}
    return [{**shared, **row} for row in crossings.found] + [
        {**shared, "goal": goal, "cpu_s": "", "steps": most} for goal in crossings.left
    ]


def table(rows: Rows) -> str:
    """Return the medians over seeds."""
    lines = []
    rows = sorted(rows, key=lambda row: [*PLAYERS].index(row["player"]))
    for (player, goal), runs in groups(rows, "player", "goal").items():
        seconds = [float("inf") if run["cpu_s"] == "" else run["cpu_s"] for run in runs]
        reached = [second for second in seconds if np.isfinite(second)]
        median = float(np.median(seconds))
        spread = f"{min(reached):.0f} to {max(reached):.0f} s" if reached else ""
        shown = f"{median:.0f} s" if np.isfinite(median) else "never"
        steps = np.median([run["steps"] for run in runs])
        lines.append([player, f"{goal:g}", f"{len(reached)} of {len(runs)}", shown, spread, f"{steps:,.0f}"])
    return markdown_table("player | score | reached | CPU, median | of those | steps, median", lines)


def main(words: Sequence[str]) -> int:
    """Run, or print the table."""
    file = HERE / "results.csv"
    if words[:1] == ["run"]:
        for seed in words[2:]:
            subprocess.run([sys.executable, __file__, "one", words[1], seed], check=True)
    elif words[:1] == ["one"]:
        new = train(words[1], int(words[2]))
        write_tables(HERE, {"results": [*(read_csv(file) if file.exists() else []), *new]})
    else:
        print(table(read_csv(file)))
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
