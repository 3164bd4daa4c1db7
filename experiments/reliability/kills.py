"""Kill runs at random moments, resume each, and compare it with an uninterrupted run."""

from __future__ import annotations

import argparse
import csv
import random
import shutil
import sys
import tempfile
import time
from pathlib import Path

import command_line
import torch

from hpamdp.messages import exit_code
from hpamdp.run import checkpoint
from hpamdp.run.state_file import StateFile

COMMON = [
    "num_envs=8", "steps_per_batch=4", "total_frames=2048", "eval.every=512", "eval.layouts=20", "log_every=128",
    "checkpoint_every=64",
]  # fmt: skip
RUNS = {
    "hppo": ["high=linucb", "low=hppo"],
    "pdqn": ["high=ucb", "low=pdqn", "low.warmup_steps=64", "low.batch_size=16", "low.hidden_dims=[16]"],
    "actor": ["high=actor", "low=hppo", "high.minibatch_size=32"],
    "meta_critic": ["high=meta_critic", "low=hsac", "low.warmup_steps=64", "low.batch_size=16"],
    "multi": ["high=ucb", "low=hppo", "collector=multi"],
}


def scores(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a run's metrics without the column of times, which differ between all runs."""
    with (folder / "metrics.csv").open() as file:
        return [{name: value for name, value in row.items() if name != "wall_s"} for row in csv.DictReader(file)]


def weights(folder: Path) -> dict[str, torch.Tensor]:
    """Return the agent's tensors of a run's checkpoint."""
    state: dict[str, torch.Tensor] = StateFile(folder / "policy.safetensors").read("agent")
    return state


def is_same(one: Path, other: Path) -> bool:
    """Return whether two runs have the same rows of metrics and the same weights, to the last bit."""
    mine, theirs = weights(one), weights(other)
    is_equal = all(torch.equal(value, theirs[name]) for name, value in mine.items() if torch.is_tensor(value))
    return scores(one) == scores(other) and mine.keys() == theirs.keys() and is_equal


def main() -> None:
    """Print a row for each kind of run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    moments = random.Random(arguments.seed)
    counts = {name: {"kills": 0, "nothing saved yet": 0, "resumed": 0, "identical": 0, "leftovers": 0} for name in RUNS}
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        durations = {}
        for name, words in RUNS.items():
            begin = time.monotonic()
            ending = command_line.run([*words, *COMMON, "hydra.run.dir=run"], root / name, 600)
            assert ending.code == 0, (name, ending)
            durations[name] = time.monotonic() - begin
        try:
            for number in range(arguments.kills):
                name = list(RUNS)[number % len(RUNS)]
                folder = root / f"{name}-{number}"
                kill_and_resume(name, folder, root / name / "run", moments.uniform(0.0, durations[name]), counts[name])
                shutil.rmtree(folder)
        except KeyboardInterrupt:
            print("stopped early")
    print("| run | " + " | ".join(counts["hppo"]) + " |")
    for name, row in counts.items():
        print(f"| {name} | " + " | ".join(map(str, row.values())) + " |")


def kill_and_resume(name: str, folder: Path, whole: Path, moment: float, count: dict[str, int]) -> None:
    """Kill a run after `moment` seconds, perhaps twice, resume it to its end, and count the result."""
    process = command_line.start([*RUNS[name], *COMMON, "hydra.run.dir=run"], folder)
    process.join(moment)
    process.kill()
    process.join()
    count["kills"] += 1
    if not (folder / "run" / checkpoint.FILE_NAME).is_file():
        count["nothing saved yet"] += 1
        return
    ending = command_line.run([f"resume={folder / 'run'}", f"hydra.run.dir={folder / 'run'}"], folder, 600)
    if ending.code != 0:
        print(name, moment, ending)
        return
    count["resumed"] += 1
    count["identical"] += is_same(folder / "run", whole)
    known = {path.name for path in whole.iterdir()}
    count["leftovers"] += any(path.name not in known for path in (folder / "run").iterdir())


if __name__ == "__main__":
    sys.exit(exit_code(main))
