"""Tabulate the hostile inputs of hostile_round.py before and after the checks.

python experiments/reliability/study.py    tabulates the stored hostile.csv
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.study_tables import markdown_table, read_csv
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
OUTCOMES = ("traceback", "silent", "harm")


def main(words: Sequence[str]) -> None:
    """Print a line for each kind of input."""
    if words:
        raise SystemExit(f"takes no words, but was given {' '.join(words)}")
    lines = []
    for row in read_csv(HERE / "hostile.csv"):
        counts = [row[f"{outcome}_{when}"] for when in ("before", "after") for outcome in OUTCOMES]
        lines.append([row["kind"], f"{row['cases']:,}", *counts])
    outcomes = "traceback | wrong in silence | harm"
    print(markdown_table(f"kind | cases | before: {outcomes} | after: {outcomes}", lines))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
