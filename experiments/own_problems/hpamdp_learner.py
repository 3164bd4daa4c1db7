"""Train a learner of hpamdp with its defaults.

python experiments/own_problems/hpamdp_learner.py PROBLEM LEARNER SEED FILE CPU_SECONDS [SETTING=VALUE]...
    writes the curve to a csv file. The learner's name in the file is followed by the settings.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import torch
import yaml
from tensordict import TensorDict

import hpamdp
from experiments.own_problems.problems import EPISODE_SEEDS, PROBLEMS
from experiments.own_problems.protocol import Clock
from hpamdp.env.decisions import with_decisions
from hpamdp.run.evaluate import Evaluation


class Scorer(hpamdp.Callback):
    """Score the agent in episodes with these seeds while it learns, and end training when its time is over."""

    def __init__(self, seeds: Sequence[int], name: dict, file: Path, limit: float) -> None:
        self.seeds = seeds
        self.given = (name, file, limit)

    def on_start(self, trainer) -> None:
        """Make the fixed episodes."""
        problem, policy = trainer.parts.problem, trainer.parts.agent.policy
        env = type(problem)(len(self.seeds), options=problem.options)
        env.set_scaling_from(problem)
        evaluation = Evaluation(with_decisions(env), seed=0)
        evaluation.episodes = TensorDict({"seed": torch.tensor(self.seeds)}, batch_size=[len(self.seeds)])
        self.clock = Clock(lambda: float(evaluation.run(policy)["return"].mean()), *self.given)

    def on_batch(self, trainer) -> None:
        """Score the agent if it is due."""
        if self.clock.after(trainer.frames):
            trainer.stop("the time is over")

    def on_end(self, trainer) -> None:
        """Score the last agent, and write the file."""
        self.clock.after(trainer.frames, is_over=True)
        self.clock.write()


def main(problem: str, learner: str, seed: int, file: Path, limit: float, settings: list[str]) -> None:
    """Train and score."""
    label = " ".join([learner, *settings])
    name = {"problem": problem, "library": "hpamdp", "player": label, "seed": seed, "limit_s": limit}
    values = {key: yaml.safe_load(value) for key, value in (each.split("=") for each in settings)}
    hpamdp.train(
        PROBLEMS[problem],
        low=learner,
        seed=seed,
        progress=False,
        callbacks=[Scorer(EPISODE_SEEDS, name, file, limit)],
        **{"env.max_steps": PROBLEMS[problem].steps, **values},
    )


if __name__ == "__main__":
    problem, learner, seed, file, seconds, *settings = sys.argv[1:]
    main(problem, learner, int(seed), Path(file), float(seconds), settings)
