"""Score the learners of this study on the same episodes, by the same clock."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

import hpamdp
from experiments.study_tables import write_tables
from hpamdp.env.decisions import with_decisions
from hpamdp.run.evaluate import Evaluation

EPISODES = 1000
EPISODES_SEED = 2026  # of the evaluations; training has other episodes with any seed
CPU_LIMIT = 600.0  # seconds of training
LEAST_PAUSE = 5.0  # least CPU seconds of training between two evaluations
PAUSE = 0.15  # the pause as a fraction of the CPU time so far, once that is longer

Policy = Callable[[TensorDictBase], TensorDictBase]


def cpu_seconds() -> float:
    """Return the CPU seconds of this process and of the compilers that it started."""
    return sum(os.times()[:4])


class Curve:
    """Score a learner at intervals of its training's CPU time, in which scoring does not count.

    Args:
        problem: the name of the problem.
        policies: the greedy policies of the learner, by their names. A policy writes the discrete action and the
            parameters, in the problem's units, into a tensordict with observations `[N, observation_dim]`.
        name: columns that name the run. They precede the scores in each row.
        file: the csv file to write once the training is over.
        limit: CPU seconds of training.
    """

    def __init__(
        self,
        problem: str,
        policies: Mapping[str, Policy],
        name: Mapping[str, Any],
        file: Path,
        limit: float = CPU_LIMIT,
    ) -> None:
        self.evaluation = Evaluation(with_decisions(hpamdp.make(problem, num_envs=EPISODES)), EPISODES_SEED)
        self.policies = policies
        self.name = {**name, "problem": problem, "limit_s": limit}
        self.file = file
        self.limit = limit
        self.rows: list[dict[str, Any]] = []
        self.is_over = False
        self._began = self._due = 0.0

    def begin(self) -> None:
        """Score the untrained learner, then start the clock."""
        self._score(0, 0.0)
        self._due = LEAST_PAUSE
        self._began = cpu_seconds()

    def after(self, steps: int) -> bool:
        """Score the learner if an evaluation is due. Return whether the time is over."""
        now = cpu_seconds()
        cpu_s = now - self._began
        self.is_over = cpu_s >= self.limit
        if cpu_s >= self._due or self.is_over:
            self._score(steps, cpu_s)
            self._due = cpu_s + max(LEAST_PAUSE, PAUSE * cpu_s)
            self._began += cpu_seconds() - now
        return self.is_over

    def end(self, steps: int) -> None:
        """Score a learner that ends before its time is over, and write the file."""
        if not self.is_over:
            self._score(steps, cpu_seconds() - self._began)
        self.file.parent.mkdir(parents=True, exist_ok=True)
        write_tables(self.file.parent, {self.file.stem: self.rows})

    def _score(self, steps: int, cpu_s: float) -> None:
        for acts, policy in self.policies.items():
            played = self.evaluation.run(policy)
            means = {name: round(float(played[name].mean()), 4) for name in ("score", "success")}
            self.rows.append({**self.name, "acts": acts, "steps": steps, "cpu_s": round(cpu_s, 1), **means})
            print(self.rows[-1], flush=True)
