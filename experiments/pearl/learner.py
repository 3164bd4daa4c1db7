"""Train hpamdp's learner on Pinball's simple map or on Office, with the settings of `experiments/problems`.

python experiments/pearl/learner.py pinball|office SEED FILE    writes the curve to a csv file
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import hpamdp
from experiments.study_tables import write_tables
from hpamdp.messages import exit_code

SETTINGS: dict[str, dict[str, Any]] = {
    "pinball": {"low": "pdqn", "eval.every": 5_000, "eval.layouts": 1},
    "office": {
        "low": "hppo",
        "env.tiles": 20,
        "exploration": "counts",
        "exploration.resolution": 1.0,
        "exploration.weight": 25.0,
        "eval.every": 50_000,
        "eval.layouts": 100,
    },
}


class Curve(hpamdp.Callback):
    """Keep each evaluation with the number of episodes that had ended and the CPU seconds, evaluations included."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self.is_finished = False

    def on_evaluation(self, trainer, row: Mapping[str, float]) -> None:
        """Keep an evaluation. Each environment numbers its episodes from 0."""
        self.is_finished = trainer.frames >= trainer.config.run.num_frames
        episodes = trainer.parts.env.state.episode.sum().item() if trainer.frames else 0
        self.rows.append(
            {
                "episodes": episodes,
                "steps": trainer.frames,
                "cpu_s": round(trainer.cpu_s, 1),
                "score": round(row["eval/score"], 1),
                "success": round(row["eval/success"], 4),
            }
        )


def main(problem: str, seed: int, file: Path) -> None:
    """Train and score."""
    curve = Curve()
    settings = SETTINGS[problem]
    hpamdp.train(
        problem,
        high=None,
        seed=seed,
        threads=1,
        progress=False,
        callbacks=[curve],
        **{"eval.seed": seed, "compile_updates": False, "film": False, **settings},
    )
    if not curve.is_finished:
        raise SystemExit(f"{problem}, seed {seed}: stopped before its end")
    name = {
        "problem": problem,
        "library": "hpamdp",
        "version": hpamdp.__version__,
        "learner": settings["low"],
        "seed": seed,
    }
    file.parent.mkdir(parents=True, exist_ok=True)
    write_tables(file.parent, {file.stem: [name | row for row in curve.rows]})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problem", choices=SETTINGS)
    parser.add_argument("seed", type=int)
    parser.add_argument("file", type=Path)
    given = parser.parse_args()
    sys.exit(exit_code(lambda: main(given.problem, given.seed, given.file)))
