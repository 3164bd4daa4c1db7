"""Train a learner of hpamdp with its recipe.

python experiments/peers/hpamdp_learner.py PROBLEM LEARNER SEED FILE [CPU_SECONDS] [SETTING=VALUE]...
    writes the curve to a csv file. The learner's name in the file is followed by the settings.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

import yaml
from protocol import CPU_LIMIT, Curve

import hpamdp


class Clock(hpamdp.Callback):
    """Score the agent while it learns, and end training when its time is over."""

    def __init__(self, problem: str, name: Mapping[str, str], file: Path, limit: float) -> None:
        self.given = (problem, name, file, limit)
        self.curve: Curve | None = None

    def on_evaluation(self, trainer, row) -> None:
        """Start the clock after the run's own first evaluation."""
        if self.curve is None:
            problem, name, file, limit = self.given
            is_sampled = trainer.config.to_dict()["low"].get("greedy_discrete") == "sampled"
            acts = "sampled" if is_sampled else "greedy"
            self.curve = Curve(problem, {acts: trainer.parts.agent.policy}, name, file, limit)
            self.curve.begin()

    def on_batch(self, trainer) -> None:
        """Score the agent if it is due."""
        if self.curve.after(trainer.frames):
            trainer.stop("the time is over")

    def on_end(self, trainer) -> None:
        """Score the agent once more if it ends before its time, and write the file."""
        self.curve.end(trainer.frames)


def main(problem: str, learner: str, seed: int, file: Path, limit: float, settings: list[str]) -> None:
    """Train and score."""
    hpamdp.make(problem).rollout(2)  # compiles the problem's kernels, once for each machine
    label = " ".join([learner, *settings])
    name = {"library": "hpamdp", "version": hpamdp.__version__, "learner": label, "seed": seed}
    values = {key: yaml.safe_load(value) for key, value in (each.split("=") for each in settings)}
    hpamdp.train(
        problem,
        low=learner,
        high=None,
        seed=seed,
        threads=1,
        progress=False,
        callbacks=[Clock(problem, name, file, limit)],
        **{"eval.every": 0, "film": False, **values},
    )


if __name__ == "__main__":
    problem, learner, seed, file, *others = sys.argv[1:]
    seconds = float(others.pop(0)) if others and "=" not in others[0] else CPU_LIMIT
    main(problem, learner, int(seed), Path(file), seconds, others)
