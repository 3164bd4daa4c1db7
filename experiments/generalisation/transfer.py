"""Train with one controller and score with the other, without any training there.

python experiments/generalisation/transfer.py    trains every learner of `LEARNERS` with each controller and every seed,
                                                 and writes the scores with both controllers to transfer.csv

A learner that sees observations alone learns where its keys push, and nothing tells it that they push elsewhere now.
PETS in a canonical frame is told the directions of a controller's keys. It learns what a press does along one,
which holds for the other controller as well.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import hpamdp
from experiments.study_tables import Rows, write_tables
from hpamdp.env.boatdock.harbour import CONTROLLERS
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
SEEDS = range(3)
EPISODES = 1000
EVALUATION_SEED = 99
LEARNERS: dict[str, dict[str, Any]] = {
    "hppo": {"low": "hppo", "total_frames": 1_000_000, "eval.every": 500_000},
    "pdqn": {"low": "pdqn", "total_frames": 200_000, "eval.every": 100_000},
    "pets, told the directions": {"low": "pets", "total_frames": 384, "eval.every": 384, "compile_updates": False},
    "pets, not told": {
        "low": {"name": "pets", "augment": False},
        "total_frames": 1024,
        "eval.every": 1024,
        "compile_updates": False,
    },
}


def scores(name: str, trained_on: str, seed: int) -> Iterator[dict[str, Any]]:
    """Train a learner with a controller; yield a row of its score with each controller."""
    settings = {"high": None, "seed": seed, "eval.layouts": 250, "progress": False, **LEARNERS[name]}
    agent = hpamdp.train({"name": "boatdock", "controller": trained_on}, **settings)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "agent.safetensors"
        agent.save(file)
        for controller in CONTROLLERS:
            loaded = hpamdp.load(file, **{"env.controller": controller})
            figures = loaded.evaluate(episodes=EPISODES, seed=EVALUATION_SEED)
            yield {
                "learner": name,
                "trained_on": trained_on,
                "controller": controller,
                "seed": seed,
                "score": round(figures["score"], 4),
                "success": round(figures["success"], 4),
            }


def main() -> int:
    """Train and score all of them."""
    rows: Rows = []
    for name in LEARNERS:
        for trained_on in CONTROLLERS:
            for seed in SEEDS:
                rows += scores(name, trained_on, seed)
                print(rows[-1], flush=True)
                write_tables(HERE, {"transfer": rows})
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
