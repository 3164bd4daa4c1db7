"""Time an update of every learner, and compare it with the time of its matrix products alone.

python experiments/speed/study.py            prints the table of results.csv
python experiments/speed/study.py run        measures all learners with one thread, renews results.csv, prints the table
python experiments/speed/study.py run hppo   measures some learners alone

The products are those of the timed updates, forward and backward. They are recorded while PyTorch runs them, and
repeated on random numbers of the same shapes and strides. Updates and products are timed in turns, in CPU time, which
leaves out other processes. The fastest turn of each counts.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.collectors import Collector

from experiments.study_tables import Rows, markdown_table, read_csv, write_tables
from hpamdp.config.compose import read
from hpamdp.config.outside_jobs import composed
from hpamdp.messages import exit_code
from hpamdp.policies.base import Learner
from hpamdp.run.assemble import AssembledRun, assemble

HERE = Path(__file__).resolve().parent
LEARNERS = ["hppo", "pdqn", "hyar", "hsac", "paddpg", "dlpa", "pets", "iql", "td3_bc"]
# Each turn has enough updates to include periodic work, such as HyAR's codec every 10 updates.
UPDATES = 20
TURNS = 6
STORED = 20_000  # steps before the first turn; fewer if the learner's budget is small
ATEN = torch.ops.aten
PRODUCTS = {ATEN.mm.default, ATEN.addmm.default, ATEN.bmm.default, ATEN.baddbmm.default}

Product = tuple[Callable[..., Tensor], list[Any], dict[str, Any]]


class Products(TorchDispatchMode):
    """Record the matrix products inside the block, with random numbers in place of their operands."""

    def __init__(self) -> None:
        super().__init__()
        self.made: list[Product] = []
        self._same: dict[Any, Tensor] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation, and record it if it is a product."""
        kwargs = kwargs or {}
        if func in PRODUCTS:
            self.made.append((func, [self._like(each) for each in args], kwargs))
        return func(*args, **kwargs)

    def _like(self, each: Any) -> Any:
        if not isinstance(each, Tensor):
            return each
        place = (each.dtype, each.shape, each.stride())
        if place not in self._same:
            self._same[place] = torch.randn_like(each)  # keeps the strides of a tensor without gaps
        return self._same[place]


def make(name: str) -> tuple[AssembledRun, Learner, int]:
    """Return the parts of a run with the congruent controller and defaults, the learner, and the steps of a batch."""
    # The codec's first updates only delay those that are timed.
    shortened = ["low.codec_pretrain_updates=10"] if name == "hyar" else []
    fixed = ["high=none", "env.controller=congruent", "eval.layouts=10", "compile_updates=false"]
    with composed([*fixed, f"low={name}", *shortened]) as cfg:
        config = read(cfg)
    torch.manual_seed(0)
    parts = assemble(config)
    return parts, parts.agent.learners[0], config.run.num_envs * config.run.steps_per_batch


def updates_of(name: str) -> tuple[Callable[[], object], int, Learner]:
    """Return a function that makes updates, their number (for H-PPO, optimisation steps), and the learner."""
    parts, learner, batch_size = make(name)
    collector = Collector(
        parts.env, parts.policy, frames_per_batch=batch_size, total_frames=-1, auto_register_policy_transforms=False
    )
    batches = iter(collector)
    batch = next(batches)
    mask = torch.ones(batch.shape, dtype=torch.bool)
    if name == "hppo":
        num_updates = learner.options.epochs * (batch.numel() // learner.options.minibatch_size)
        return lambda: learner.learn(batch, mask), num_updates, learner
    stored = 0
    while stored < min(STORED, 20 * batch_size):
        learner.add_demonstrations(batch, mask)
        stored += batch.numel()
        batch = next(batches)
    return lambda: learner.update(UPDATES), UPDATES, learner


def measure(name: str) -> dict[str, Any]:
    """Return a row of the table: CPU ms of an update (plain, compiled and with bfloat16) and of its products."""
    update, num_updates, learner = updates_of(name)
    update()
    with Products() as products:
        update()
    made = products.made

    def floor() -> None:
        with torch.no_grad():
            for func, args, kwargs in made:
                func(*args, **kwargs)

    update_ms, products_ms = in_turns(update, floor, num_updates)
    learner.compile_updates()
    update()
    compiled_ms, products_again_ms = in_turns(update, floor, num_updates)
    learner.lower_precision()
    update()
    lower_ms, products_at_last_ms = in_turns(update, floor, num_updates)
    return {
        "learner": name,
        "update_ms": round(update_ms, 3),
        "products_ms": round(products_ms, 3),
        "ratio": round(update_ms / products_ms, 2),
        "compiled_ms": round(compiled_ms, 3),
        "compiled_ratio": round(compiled_ms / products_again_ms, 2),
        "bfloat16_ms": round(lower_ms, 3),
        "bfloat16_ratio": round(lower_ms / products_at_last_ms, 2),
        "products": round(len(made) / num_updates, 1),
    }


def in_turns(update: Callable[[], object], floor: Callable[[], object], num_updates: int) -> list[float]:
    """Return the CPU ms per update of both functions, in their fastest turns."""
    best = [float("inf"), float("inf")]
    for _ in range(TURNS):
        for i, run in enumerate((update, floor)):
            started = time.process_time()
            run()
            best[i] = min(best[i], time.process_time() - started)
    return [1_000.0 * seconds / num_updates for seconds in best]


def table(rows: Rows) -> str:
    """Return a line for each learner."""
    head = "learner | ms an update | ms of products | ratio | ms compiled | ratio | and bfloat16 | ratio | products"
    columns = ("update_ms", "products_ms", "ratio", "compiled_ms", "compiled_ratio", "bfloat16_ms", "bfloat16_ratio")
    return markdown_table(
        head, ([row["learner"], *(f"{row[name]:.2f}" for name in columns), f"{row['products']:.1f}"] for row in rows)
    )


def main(words: Sequence[str]) -> None:
    """Measure if asked, tabulate."""
    if not words:
        print(table(read_csv(HERE / "results.csv")))
        return
    unknown = set(words[1:]) - set(LEARNERS)
    if words[0] != "run" or unknown:
        raise SystemExit(f"{' '.join(words)}: the arguments are run and, after it, any of {', '.join(LEARNERS)}")
    torch.set_num_threads(1)
    names = words[1:] or LEARNERS
    rows = {row["learner"]: row for row in read_csv(HERE / "results.csv")}
    for name in names:
        rows[name] = measure(name)
        write_tables(HERE, {"results": [rows[each] for each in LEARNERS if each in rows]})
    print(table([rows[name] for name in names]))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
