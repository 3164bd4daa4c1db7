"""Train agents on boats other than people's, and on boats that may be changed inside an episode.

python experiments/options/train_boats.py WORDS    trains with these words of the command line, and adds a row to
                                                   boats.csv
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from train_rooms import add_row

from hpamdp.messages import exit_code

FILE = Path(__file__).resolve().parent / "boats.csv"
FIGURES = (
    "score",
    "success",
    "steps",
    "oracle_agreement",
    "oracle_agreement_weighted",
    "option_changes",
    "frames",
    "cpu_s",
)
COMMON = ["film=false", "eval.every=500000"]


def train(words: Sequence[str]) -> dict[str, Any]:
    """Train one agent and return its row."""
    with tempfile.TemporaryDirectory() as folder:
        run = [sys.executable, "-m", "hpamdp.cli", *COMMON, *words, f"hydra.run.dir={folder}", "overwrite=true"]
        code = subprocess.run(run).returncode
        if code:
            raise SystemExit(code)  # the run has said why
        return row_of(json.loads((Path(folder) / "summary.json").read_text()), words)


def row_of(summary: Mapping[str, Any], words: Sequence[str]) -> dict[str, Any]:
    """Return the row of a finished run."""
    ceiling = summary["references"]["ceiling"]["score"]
    figures = {name: round(summary[name], 4) for name in FIGURES if name in summary}
    share = round(summary["score"] / ceiling, 4)
    return {"words": " ".join(words), "seed": summary["seed"], "ceiling": round(ceiling, 4), "share": share, **figures}


def main(words: Sequence[str]) -> None:
    """Train and add the row."""
    if not all(any(word.startswith(f"{level}=") for word in words) for level in ("high", "low")):
        raise SystemExit("give words of the command line, high=... and low=... among them; nothing was trained")
    add_row(FILE, train(words), ("words", "seed"), sorts=False)
    print(f"{FILE}: a row added; study.py tabulates it")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
