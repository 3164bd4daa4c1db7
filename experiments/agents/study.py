"""Tabulate the agents that come with the code, from their own configs and summaries.

python experiments/agents/study.py
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from hpamdp.messages import exit_code

AGENTS = Path(__file__).resolve().parents[2] / "agents"
# Settings of problems in which agents differ.
SHOWN_SETTINGS = ("controller", "n", "task", "demand")
HEAD = ("agent", "problem", "selector", "learner", "score", "ceiling", "success", "length", "trained for", "CPU, s")


def row(folder: Path) -> list[str]:
    """Return an agent's cells."""
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    env = yaml.safe_load((folder / "config.yaml").read_text())["env"]
    shown = [f"{name}={env[name]}" for name in SHOWN_SETTINGS if name in env and env[name] != "choose"]
    ceiling = summary.get("ceiling")
    return [
        f"`{folder.name}`",
        ", ".join([summary["env"], *shown]),
        summary["high"],
        summary["low"],
        f"{summary['score']:.3f}",
        "" if ceiling is None else f"{ceiling:.3f}",
        f"{100.0 * summary['success']:.1f}%" if "success" in summary else "",
        f"{summary['steps']:.2f}",
        f"{summary['frames']:,}",
        f"{summary['cpu_s']:.0f}",
    ]


def main(words: Sequence[str]) -> None:
    """Print the table."""
    if words:
        raise SystemExit(f"takes no words, but was given {' '.join(words)}")
    folders = sorted((file.parent for file in AGENTS.glob("*/summary.json")), key=_order)
    for cells in (HEAD, ["---"] * len(HEAD), *map(row, folders)):
        print(f"| {' | '.join(cells)} |")


def _order(folder: Path) -> tuple[bool, str, int, str]:
    """Return the place of a line: the boats first, then the problems by name, Hard Move by its number of actuators."""
    problem = json.loads((folder / "summary.json").read_text())["env"]
    return problem != "boatdock", problem, len(folder.name), folder.name


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
