"""Train with and without a memory on Cue, a problem that cannot be solved without one, and tabulate.

python experiments/memory/study.py 100 101 102    trains with these seeds, and adds rows to results.csv
python experiments/memory/study.py                tabulates results.csv

Cue is in `tests/toy_memory.py`: its first observation says which action is rewarded in its last step. The best return
is 1, and the best one without a memory 0 on average. In the selectors' version, `CueOfOptions`, options last one step,
and only the last one is rewarded.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec

import hpamdp
from experiments.study_tables import Rows, add_to_tables, groups, markdown_table, mean_of, read_csv, with_enough_seeds
from hpamdp import keys
from hpamdp.analysis.statistics import spread
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent.parent / "tests"))
from toy_memory import Cue  # noqa: E402

EPISODES = 500  # of the evaluation
RUN = ("learns", "memory", "seed")
QUIET = {"eval.every": 0, "eval.layouts": 4, "film": False, "progress": False, "threads": 1}
LEARNERS: dict[str, dict[str, Any]] = {
    "hppo": {"total_frames": 20_480},
    "pdqn": {"total_frames": 6000, "low.warmup_steps": 1000, "low.epsilon_steps": 3000},
    "hsac": {"total_frames": 6000, "low.warmup_steps": 1000},
}
SELECTORS: dict[str, dict[str, Any]] = {
    "actor": {},
    "meta_critic": {},
    "option_critic": {"high.epsilon_steps": 5000},
}
OF_SELECTORS = {
    "low": "random",
    "high.gamma": 0.9,
    "agent.termination": "steps",
    "agent.option_length": 1,
    "total_frames": 12_288,
    "num_envs": 16,
    "steps_per_batch": 16,
}
MEMORIES = ("none", "stack", "gru")
REFUSED = ("option_critic", "gru")  # it learns from single steps


class CueOfOptions(Cue):
    """The cue says which of two options is rewarded."""

    option_names = ("left", "right")

    def begin(self, low: float, high: float, seed: int, **observed: TensorSpec) -> None:
        """Make the specs, with an option among the action leaves, and set the seed."""
        super().begin(low, high, seed, has_option=True, **observed)

    def earned(self, tensordict: TensorDictBase) -> Tensor:
        """Return what the options of a last step earn, `[N]`."""
        return torch.where(tensordict[keys.OPTION] == (self.cue > 0.0).long(), 1.0, -1.0)


def train(name: str, memory: str, seed: int) -> dict[str, Any]:
    """Train a learner or a selector with a memory and return its row."""
    if name in LEARNERS:
        problem, settings = Cue, {"low": name, "low.memory": memory, **LEARNERS[name]}
    else:
        problem, settings = CueOfOptions, {"high": name, "high.memory": memory, **OF_SELECTORS, **SELECTORS[name]}
    cpu = time.process_time()
    agent = hpamdp.train(problem, seed=seed, **{"eval.seed": seed}, **QUIET, **settings)
    cpu = time.process_time() - cpu
    return {
        "learns": name,
        "memory": memory,
        "seed": seed,
        "frames": settings["total_frames"],
        "score": round(agent.evaluate(episodes=EPISODES)["score"], 4),
        "cpu_s": round(cpu, 1),
    }


def table(rows: Rows) -> str:
    """Return a line for each learner and selector: the mean greedy return with each memory."""
    lines = []
    by_name = groups(with_enough_seeds(rows, *RUN[:-1]), "learns")
    for name in (*LEARNERS, *SELECTORS):
        if (name,) not in by_name:
            continue
        of_name = by_name[name,]
        cells = groups(of_name, "memory")
        scores = [spread([row["score"] for row in cells[memory,]]) if (memory,) in cells else "" for memory in MEMORIES]
        seeds = {row["seed"] for row in of_name}
        seconds = [mean_of(cells[memory,], "cpu_s") for memory in ("none", "gru") if (memory,) in cells]
        shown = f"`{'low' if name in LEARNERS else 'high'}={name}`"
        costs = f"{of_name[0]['frames']:,}", ", ".join(f"{mean:.0f} s" for mean in seconds)
        lines.append([shown, *scores, len(seeds), *costs])
    memories = " | ".join(f"`{memory}`" for memory in MEMORIES)
    return markdown_table(f"| {memories} | seeds | steps | CPU with `none`, `gru`", lines)


def main(words: Sequence[str]) -> None:
    """Train with each seed, if any are given, and tabulate."""
    if any(not word.isdecimal() for word in words):
        raise SystemExit(f"give seeds, such as 100 101 102, not {' '.join(words)}")
    for seed in map(int, words):
        for name in (*LEARNERS, *SELECTORS):
            for memory in MEMORIES:
                if (name, memory) != REFUSED:
                    add_to_tables(HERE, {"results": [train(name, memory, seed)]}, RUN)
    print(table(read_csv(HERE / "results.csv")))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
