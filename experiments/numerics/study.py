"""Train the same seed under other numerics, and tell how far the run keeps to that of one eager thread in float32.

python experiments/numerics/study.py FOLDER    makes the runs that FOLDER lacks, and adds them to results.csv
python experiments/numerics/study.py           prints the table
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

from experiments.study_tables import Rows, read_csv, write_tables
from hpamdp.metrics_file import CPU_SECONDS, FRAMES, WALL_SECONDS, read_rows

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent

BASE = "base"
# Words of the command line and environment variables of each run.
NUMERICS: dict[str, tuple[list[str], dict[str, str]]] = {
    BASE: ([], {}),
    "again": ([], {}),
    "two threads": (["threads=2"], {}),
    "AVX2": (
        [],
        {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"},
    ),  # MKL, which multiplies matrices, does not read PyTorch's variable
    "compiled": (["compile_updates=true"], {}),
    "bfloat16": (["update_precision=bfloat16"], {}),
    "another seed": (["seed=502"], {}),
}
# Few steps with as many updates as possible.
LEARNERS = {
    "hppo": "total_frames=131072 log_every=16384",
    "pdqn": "total_frames=24000 low.warmup_steps=1000 log_every=1000",
    "hyar": "total_frames=12000 low.warmup_steps=1000 log_every=1000",
    "hsac": "total_frames=12000 low.warmup_steps=1000 log_every=1000",
    "pets": "total_frames=192 log_every=16",
}
ROUNDING = 1e-6  # largest relative difference of losses that counts as rounding


def run(folder: Path, low: str, numerics: str) -> None:
    """Train a learner on the congruent boat, unless its folder has a summary."""
    if (folder / "summary.json").is_file():
        return
    words, variables = NUMERICS[numerics]
    fixed = ["high=none", "env.controller=congruent", f"low={low}", *LEARNERS[low].split(), "compile_updates=false"]
    fixed += ["eval.every=0", "eval.layouts=1000", "film=false", "seed=501", f"hydra.run.dir={folder}"]
    given = {word.partition("=")[0]: word for word in [*fixed, *words]}
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), **variables}
    subprocess.run([sys.executable, str(ROOT / "run.py"), *given.values()], env=environment, check=True)


def compared(base: Path, other: Path) -> dict[str, float | str]:
    """Return the steps from which a run's losses differ from those of the base, and the distance at the end."""
    times = {FRAMES, WALL_SECONDS, CPU_SECONDS}
    differs = leaves = ""
    for one, two in zip(read_rows(base / "metrics.csv"), read_rows(other / "metrics.csv"), strict=True):
        names = [name for name in one if name not in times and not name.startswith("eval/")]
        largest = max((abs(one[name] - two[name]) / max(1.0, abs(one[name])) for name in names), default=0.0)
        differs = differs or (f"{one[FRAMES]:.0f}" if largest > 0.0 else "")
        leaves = leaves or (f"{one[FRAMES]:.0f}" if largest > ROUNDING else "")
    weights = [load_file(folder / "policy.safetensors") for folder in (base, other)]
    real = [name for name, value in weights[0].items() if np.issubdtype(value.dtype, np.floating)]
    largest = max(float(np.abs(weights[0][name] - weights[1][name]).max(initial=0.0)) for name in real)
    scores = [json.loads((folder / "summary.json").read_text())["score"] for folder in (base, other)]
    return {"differs": differs, "leaves": leaves, "weights": largest, "score": scores[1] - scores[0]}


def gather(folder: Path) -> Rows:
    """Make the runs, and return a row for each learner under each of the other numerics."""
    rows: Rows = []
    for low in LEARNERS:
        for numerics in NUMERICS:
            run(folder / low / numerics.replace(" ", "_"), low, numerics)
            if numerics != BASE:
                pair = [folder / low / name.replace(" ", "_") for name in (BASE, numerics)]
                rows.append({"learner": low, "numerics": numerics, **compared(*pair)})
    return rows


def table(rows: Rows) -> str:
    """Return a line for each learner: how far it keeps to the base under each of the other numerics."""
    columns = [name for name in NUMERICS if name != BASE]
    lines = ["| learner | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    cells = {(row["learner"], row["numerics"]): row for row in rows}
    for low in LEARNERS:
        lines.append(f"| {low} | " + " | ".join(_cell(cells.get((low, name))) for name in columns) + " |")
    return "\n".join(lines)


def _cell(row: dict | None) -> str:
    if row is None:
        return "-"
    if row["differs"] == "" and row["weights"] == 0.0:
        return "equal"
    if row["leaves"] == "":
        return f"rounding, weights {row['weights']:.0e}"
    return f"from {row['leaves']:,.0f} steps, weights {row['weights']:.0e}, score {row['score']:+.2f}"


def main(folders: list[str]) -> None:
    """Run and tabulate."""
    if folders:
        write_tables(HERE, {"results": gather(Path(folders[0]).absolute())})
    print(table(read_csv(HERE / "results.csv")))


if __name__ == "__main__":
    main(sys.argv[1:])
