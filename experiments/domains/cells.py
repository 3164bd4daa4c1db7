"""Train the cells of the study that are not finished yet, in the order of cells.csv.

python experiments/domains/cells.py                      trains all, one after the other
python experiments/domains/cells.py platform/hppo goal   trains these cells and all of a domain
python experiments/domains/cells.py --processes 2        trains two at a time, each with one thread
python experiments/domains/cells.py --list               says what is left

A run goes to `multirun/domains/DOMAIN/LEARNER/SEED`, and an interrupted one continues. `study.py` gathers them. Runs
that it has stored in results.csv are not made again.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from experiments.study_tables import PLAN_NAME, planned_seeds, read_csv
from hpamdp.messages import exit_code
from hpamdp.run_files import saved_summary

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
RUNS = Path("multirun/domains")


def runs(names: Sequence[str]) -> Iterator[tuple[Path, list[str]]]:
    """Yield folder and arguments of each run of these domains and `DOMAIN/LEARNER` cells; of all, if no name is given.

    Raises:
        SystemExit: a name is in no row of cells.csv.
    """
    cells, planned = read_csv(HERE / PLAN_NAME), planned_seeds(HERE / PLAN_NAME)
    known = {cell["domain"] for cell in cells} | {f"{cell['domain']}/{cell['learner']}" for cell in cells}
    for name in names:
        if name not in known:
            raise SystemExit(
                f"{name}: is neither a domain nor a cell of cells.csv; there are {', '.join(sorted(known))}"
            )
    for cell in cells:
        name = f"{cell['domain']}/{cell['learner']}"
        if names and not {name, cell["domain"]} & {*names}:
            continue
        for seed in planned[cell["domain"], cell["learner"]]:
            folder = RUNS / name / str(seed)
            yield (
                folder,
                [
                    f"experiment=domains/{cell['domain']}",
                    f"low={cell['low']}",
                    *shlex.split(cell["settings"]),
                    f"seed={seed}",
                    "film=false",
                    "hydra.mode=RUN",
                    f"hydra.run.dir={folder}",
                    "resume=auto",
                ],
            )


def stored_runs() -> set[Path]:
    """Return the folders of the runs whose scores are in results.csv."""
    return {RUNS / row["domain"] / row["learner"] / str(row["seed"]) for row in read_csv(HERE / "results.csv")}


def is_finished(folder: Path) -> bool:
    """Return whether a run in this folder has come to its end."""
    return bool((saved_summary(folder) or {}).get("finished"))


def train(folder: Path, arguments: Sequence[str]) -> bool:
    """Run a command with one thread, its output in a file beside the run. Return whether it succeeded."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_suffix(".log").open("w") as log:
        threads = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        command = [sys.executable, str(ROOT / "run.py"), *arguments]
        done = subprocess.run(command, stdout=log, stderr=subprocess.STDOUT, env=os.environ | threads)
    return done.returncode == 0


def main() -> int:
    """Train what is left; return 1 if a run failed, else 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cells", nargs="*", help="domains, or DOMAIN/LEARNER; all if none is given")
    parser.add_argument("--processes", type=int, default=1, help="runs at a time")
    parser.add_argument("--list", action="store_true", help="print the commands of the runs that are left")
    options = parser.parse_args()
    stored = stored_runs()
    planned = [(folder, arguments) for folder, arguments in runs(options.cells) if folder not in stored]
    left = [(folder, arguments) for folder, arguments in planned if not is_finished(folder)]
    if options.list:
        for _, arguments in left:
            print(f"python run.py {shlex.join(arguments)}")
        return 0

    def train_one(run: tuple[Path, list[str]]) -> bool:
        folder, arguments = run
        is_done = train(folder, arguments)
        print(f"{'finished' if is_done else 'FAILED, see the log of'} {folder}", flush=True)
        return is_done

    with ThreadPoolExecutor(options.processes) as pool:
        return 0 if all([*pool.map(train_one, left)]) else 1


if __name__ == "__main__":
    sys.exit(exit_code(main))
