"""Train PEARL with its authors' code and settings on their own Pinball or Office.

python experiments/pearl/pearl.py PEARL_FOLDER pinball|office SEED FILE [EPISODES]
    writes the curve to a csv file. PEARL_FOLDER is a clone of the authors' repository.
"""

from __future__ import annotations

import argparse
import csv
import os
import runpy
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np

# Episodes of training, and of an evaluation. Pinball's environment has no randomness, and an episode takes seconds.
TRAINING = {"pinball": 1000, "office": 2100}
EVALUATION = {"pinball": 1, "office": 100}


class NoWriter:
    """Stand in for TensorBoard's writer, so that logs need no installation and no time."""

    def __init__(self, **kwargs: Any) -> None:
        pass

    def add_scalar(self, *args: Any) -> None:
        """Ignore a value."""

    def close(self) -> None:
        """Do nothing."""


def cpu_seconds() -> float:
    """Return the CPU seconds of this process."""
    return sum(os.times()[:2])


def keep_curve(name: dict[str, Any], file: Path) -> None:
    """Make PEARL's code write each evaluation to the file. The CPU time of evaluations does not count.

    Pictures and tables of values are left out.
    """
    from src.agents.pearl import PEARL
    from src.data_structures.cat import CAT
    from src.misc.log import LogExperiments

    def ignore(*args: Any, **kwargs: Any) -> None:
        pass

    for owner, method in (
        (CAT, "plot_cat"),
        (LogExperiments, "plot_result"),
        (LogExperiments, "print_qtable"),
        (LogExperiments, "save_execution"),
    ):
        if not hasattr(owner, method):
            raise SystemExit(f"{owner.__name__}.{method}: this version of PEARL's code does not have it")
        setattr(owner, method, ignore)

    evaluate = PEARL.evaluate_policy
    rows: list[dict[str, Any]] = []
    evaluations_cpu_s = 0.0
    began = cpu_seconds()

    def evaluate_and_keep(self, episode, *args: Any, **kwargs: Any) -> float:
        nonlocal evaluations_cpu_s
        now = cpu_seconds()
        success = evaluate(self, episode, *args, **kwargs)
        returns = self.log._evaluation_data["reward_list"][-1]
        rows.append(
            {
                **name,
                "episodes": episode,
                "steps": sum(self.log._learning_data["steps"]),
                "cpu_s": round(now - began - evaluations_cpu_s, 1),
                "score": round(float(np.mean(returns)), 1),
                "success": round(float(success), 4),
            }
        )
        with file.open("w", newline="") as opened:
            writer = csv.DictWriter(opened, rows[0])
            writer.writeheader()
            writer.writerows(rows)
        evaluations_cpu_s += cpu_seconds() - now
        return success

    PEARL.evaluate_policy = evaluate_and_keep


def main(folder: Path, problem: str, seed: int, file: Path, episodes: int) -> None:
    """Train and score."""
    file.parent.mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    version = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
    tensorboard = types.ModuleType("torch.utils.tensorboard")
    tensorboard.SummaryWriter = NoWriter
    sys.modules["torch.utils.tensorboard"] = tensorboard
    name = {"problem": problem, "library": "pearl", "version": version.stdout.strip(), "learner": "pearl", "seed": seed}
    words = f"--yaml yamls/{problem}_flexible_0.yaml --trial {seed} --result_dir results --method_dir {os.getpid()}"
    words += f" --episode_max {episodes} --eval_episodes {EVALUATION[problem]}"
    sys.argv = ["main.py", *words.split()]
    unfinished = file.with_suffix(".part")
    keep_curve(name, unfinished)
    runpy.run_path("main.py", run_name="__main__")
    unfinished.rename(file)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clone", type=Path, metavar="PEARL_FOLDER")
    parser.add_argument("problem", choices=TRAINING)
    parser.add_argument("seed", type=int)
    parser.add_argument("file", type=Path)
    parser.add_argument("episodes", type=int, nargs="?")
    given = parser.parse_args()
    if not (given.clone / "main.py").is_file():
        parser.error(f"{given.clone}: is no clone of PEARL's repository: it has no main.py")
    main(
        given.clone.absolute(),
        given.problem,
        given.seed,
        given.file.absolute(),
        given.episodes or TRAINING[given.problem],
    )
