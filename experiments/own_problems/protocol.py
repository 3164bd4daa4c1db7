"""Score the players of this study on the same episodes, at the same CPU seconds."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

MARKS = (3.0, 4.0, 5.0, 7.5, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0)  # CPU seconds at which agents are scored
HERE = Path(__file__).resolve().parent


def cpu_seconds() -> float:
    """Return the CPU seconds of this process since it began, imports included, and of the compilers that it started."""
    return sum(os.times()[:4])


class Clock:
    """Score an agent at the marks. Everything counts but these scores.

    Args:
        score: returns the mean return of the greedy agent in the fixed episodes.
        name: columns that name the run, `problem` among them. They precede the scores in each row.
        file: the csv file of the run's rows.
        limit: CPU seconds at which training ends.
    """

    def __init__(self, score: Callable[[], float], name: Mapping[str, Any], file: Path, limit: float) -> None:
        self.score = score
        self.name = name
        self.file = file
        self.limit = limit
        self.rows: list[dict[str, Any]] = []
        self._left_out = 0.0
        with (HERE / "optima.csv").open() as optima:
            rows = {row["problem"]: row for row in csv.DictReader(optima)}
        row = rows.get(name["problem"], {"random": "nan", "best": "nan"})  # those of other studies have no known ends
        self._random, self._best = float(row["random"]), float(row["best"])

    def after(self, steps: int, *, is_over: bool = False) -> bool:
        """Score the agent if it has passed a mark, or is over. Return whether the time is over."""
        began = cpu_seconds()
        cpu_s = began - self._left_out
        passed = [mark for mark in MARKS if mark <= cpu_s]
        last = self.rows[-1]["mark"] if self.rows else 0.0
        is_scored = bool(self.rows) and self.rows[-1]["steps"] == steps
        if not is_scored and ((passed and passed[-1] > last) or is_over):
            value = self.score()
            way = (value - self._random) / (self._best - self._random)
            row = {**self.name, "mark": passed[-1] if passed else 0.0, "cpu_s": round(cpu_s, 2), "steps": steps}
            self.rows.append(row | {"return": round(value, 4), "way": round(way, 4)})
            print(self.rows[-1], flush=True)
            self._left_out += cpu_seconds() - began
        return cpu_s >= self.limit

    def write(self) -> None:
        """Write the rows."""
        self.file.parent.mkdir(parents=True, exist_ok=True)
        with self.file.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(self.rows[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(self.rows)
