"""Tabulate the learners of other libraries beside those of hpamdp on Platform.

python experiments/peers/study.py    tabulates results.csv
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from hpamdp.analysis.study import groups, read_csv, spread

HERE = Path(__file__).resolve().parent


def main(arguments: Sequence[str]) -> None:
    """Print the table."""
    print("| library | learner | steps | seeds | score | success | CPU, s |\n|---|---|---|---|---|---|---|")
    for (library, version, learner, frames), rows in groups(
        read_csv(HERE / "results.csv"), "library", "version", "learner", "frames"
    ).items():
        columns = [spread([row[name] for row in rows]) for name in ("score", "success")]
        cpu = spread([row["cpu_s"] for row in rows], 0)
        cells = [f"{library} {version}", learner, f"{frames:,}", str(len(rows)), *columns, cpu]
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main(sys.argv[1:])
