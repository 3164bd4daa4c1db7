"""Choose settings for the offline benchmark without a simulator, by `hpamdp judge` on held-out episodes.

python experiments/offline_benchmark/judge.py run FOLDER DOMAIN...  trains, judges and scores, renews judge.csv
python experiments/offline_benchmark/judge.py score LEARNER DOMAIN SEED...
                                                                    adds rows of the judge's choice to results.csv

Candidates learn from half of the episodes of `mixed`. A model that learns from the other half judges them. The
simulator scores them on episodes of `eval.seed=7` only to check the judge. Finished candidates in FOLDER are kept.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import hpamdp
from experiments.offline_benchmark.study import CANDIDATES, DOMAINS, add_rows, candidates, chosen_of, mixed, scored
from experiments.study_tables import Rows, read_csv, write_tables
from hpamdp.data import minari
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
SEED = 2
HELD_OUT = 0.5


def run(folder: Path, domain: str) -> Rows:
    """Train the candidates of a domain that are missing, judge all, and return a row for each."""
    rows: dict[str, dict[str, Any]] = {}
    named = [(low, *each) for low in CANDIDATES for each in candidates(low, domain).items()]
    for low, name, settings in named:
        path = folder / domain / f"{low}-{name}"
        kept = path / "score.json"
        if not kept.exists():
            half = {"data.held_out": HELD_OUT, "folder": path}
            kept.write_text(json.dumps(scored(low, domain, settings, seed=SEED, eval_seed=7, **half)))
        figures = {column: json.loads(kept.read_text())[column] for column in ("score", "cpu_s")}
        rows[str(path)] = {"domain": domain, "learner": low, "settings": name, **figures}
    judging: dict[str, Any] = {"data.dataset": mixed(domain), "offline.updates": 8000, "seed": SEED}
    for found in hpamdp.judge(*rows, data="minari", episodes=40, **judging):
        rows[found["agent"]] |= {
            "judged": round(found["return"], 4),
            "between_members": round(found["between_members"], 4),
            "coverage": round(found["coverage"], 3),
        }
    return list(rows.values())


def main(words: Sequence[str]) -> int:
    """Do what the words ask for."""
    stored = read_csv(HERE / "judge.csv") if (HERE / "judge.csv").exists() else []
    if words[:1] == ["run"]:
        for domain in words[2:] or DOMAINS:
            new = run(Path(words[1]).resolve(), domain)
            stored = [row for row in stored if row["domain"] != domain] + new
            write_tables(HERE, {"judge": stored})
    elif words[:1] == ["score"]:
        low, domain, *seeds = words[1:]
        judged = [row for row in stored if (row["domain"], row["learner"]) == (domain, low)]
        add_rows(low, domain, map(int, seeds), candidates(low, domain)[chosen_of(judged)["settings"]], "judge")
    return 0


if __name__ == "__main__":
    minari.load = cache(minari.load)
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
