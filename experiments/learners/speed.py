"""Time training and updates of every learner, at its defaults and at the sizes of the paper's released code.

python experiments/learners/speed.py       one thread; prints the table and writes speed.csv
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import NamedTuple

import torch
from torchrl.collectors import Collector

from experiments.study_tables import Rows, markdown_table, write_tables
from hpamdp.config.compose import read
from hpamdp.config.outside_jobs import composed
from hpamdp.messages import exit_code
from hpamdp.run.assemble import AssembledRun, assemble

HERE = Path(__file__).resolve().parent
PUBLISHED = ["low=pdqn", "low.twin=false", "low.target_smoothing=0", "low.policy_delay=1", "low.hidden_dims=[128]"]
EVERY_PRESS = ["low.updates_per_step=1", "low.batch_size=128", "num_envs=64", "steps_per_batch=1"]
HYAR = ["low=hyar", "low.warmup_steps=1000", "low.codec_pretrain_updates=10"]
HYAR_SIZE = ["low.hidden_dims=[256,256]", "low.codec_hidden_dim=256"]
DLPA = ["low=dlpa", "low.warmup_steps=64"]
MANY_UPDATES = ["low.updates_per_step=25"]
DLPA_SIZE = [
    "low.num_samples=1000",
    "low.num_elites=100",
    "low.num_iterations=6",
    "low.horizon=5",
    "low.batch_size=128",
]


class Case(NamedTuple):
    """Settings of a timing, and the figures of the released code on one core."""

    name: str
    overrides: list[str]
    before: int  # presses before the clock starts
    timed: int  # presses that are timed
    released_speed: float | None = None  # presses/s
    released_update: float | None = None  # ms


CASES = [
    Case("hppo, defaults", ["low=hppo"], 20_000, 200_000, 665),
    Case("P-DQN, an update a press", [*PUBLISHED, "low.multipass=false", *EVERY_PRESS], 6_000, 3_000, 295, 3.4),
    Case("MP-DQN, an update a press", [*PUBLISHED, *EVERY_PRESS], 6_000, 3_000, 194, 5.2),
    Case("pdqn, defaults", ["low=pdqn"], 6_000, 20_000, 194),
    Case("HyAR, layers of 256, an update a press", [*HYAR, *HYAR_SIZE, *EVERY_PRESS], 1_500, 2_000, 59, 15.0),
    Case("hyar, defaults", HYAR, 2_500, 20_000, 59),
    Case("DLPA, 1,000 x 6 x 5, an update a press", [*DLPA, *DLPA_SIZE], 128, 640, 2.0, 15.0),
    Case("DLPA, 1,000 x 6 x 5, 25 updates a press", [*DLPA, *DLPA_SIZE, *MANY_UPDATES], 128, 128, 2.0, 15.0),
    Case("dlpa, defaults", DLPA, 128, 1_280, 2.0),
    Case("qpamdp, defaults", ["low=qpamdp"], 60_000, 1_000_000, 1_800),
    Case("hsac, defaults", ["low=hsac"], 6_000, 20_000),
]


def run_case(case: Case) -> tuple[float, float | None]:
    """Return the presses/s of training and the ms of an update, None if the learner counts no updates."""
    parts, batch_size = build(case.overrides)
    collector = Collector(
        parts.env, parts.policy, frames_per_batch=batch_size, total_frames=-1, auto_register_policy_transforms=False
    )
    batches = iter(collector)
    for _ in range(case.before // batch_size):
        parts.agent.learn(next(batches))
    updates_before = _updates(parts)
    learning_s = 0.0
    presses = 0
    started = time.perf_counter()
    while presses < case.timed:
        batch = next(batches)
        learning_started = time.perf_counter()
        parts.agent.learn(batch)
        learning_s += time.perf_counter() - learning_started
        presses += batch.numel()
    speed = presses / (time.perf_counter() - started)
    updates = _updates(parts) - updates_before
    return speed, 1_000.0 * learning_s / updates if updates else None


def build(overrides: list[str]) -> tuple[AssembledRun, int]:
    """Return the parts of a run with the congruent controller, and the presses of a batch."""
    with composed(["high=none", "env.controller=congruent", "eval.layouts=10", *overrides]) as cfg:
        config = read(cfg)
    torch.manual_seed(0)
    return assemble(config), config.run.num_envs * config.run.steps_per_batch


def _updates(parts: AssembledRun) -> int:
    """Return the number of updates so far, 0 if the learner counts none."""
    return int(getattr(parts.agent.learners[0], "updates", 0))


def main() -> None:
    """Time every case, print a table, write the csv."""
    torch.set_num_threads(1)
    rows: Rows = []
    for case in CASES:
        speed, update_ms = run_case(case)
        row = {
            "case": case.name,
            "presses_per_s": round(speed, 1),
            "released_presses_per_s": "-" if case.released_speed is None else case.released_speed,
            "ratio": "-" if case.released_speed is None else round(speed / case.released_speed, 1),
            "update_ms": "-" if update_ms is None else round(update_ms, 2),
            "released_update_ms": "-" if case.released_update is None else case.released_update,
            "update_ratio": "-"
            if update_ms is None or not case.released_update
            else round(case.released_update / update_ms, 1),
        }
        rows.append(row)
        print(row, flush=True)
    write_tables(HERE, {"speed": rows})
    print(
        markdown_table("case | presses/s | released | ratio | ms an update | released | ratio", map(dict.values, rows))
    )


if __name__ == "__main__":
    sys.exit(exit_code(main))
