"""Order candidates of several kinds by `hpamdp judge`, and compare with their scores in the simulator.

python experiments/offline/judge.py run FOLDER   trains, judges and scores, renews judge.csv; finished runs are kept
python experiments/offline/judge.py              tabulates judge.csv

Candidates that learn from people have the even-numbered ones. The others judge all candidates, three times without a
third of them.
`judged` is the return by roll-outs, `fitted` by fitted Q evaluation, `importance` by importance sampling.
`HPAMDP_HUMAN_DATA` points at the recording.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from scipy import stats

import hpamdp
from experiments.study_tables import Rows, groups, markdown_table, read_csv, write_tables
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
SEED = 41
METHODS = ["judged", "fitted", "importance"]
FOLDS = [[person for person in range(1, 40, 2) if person % 6 != without] for without in (1, 3, 5)]
LEARNING = "data.people=[" + ",".join(map(str, range(0, 40, 2))) + "]"
OFFLINE = f"mode=offline data=human {LEARNING} offline.eval_every=0"
ONE_PERSON = OFFLINE.replace(LEARNING, "data.people=[4]")
CLEAN = "data.rest_to_rest=clean"
# Words of each candidate's run; its kind is the part of its name before the hyphen.
CANDIDATES = {
    **{f"bc-{n}": f"{OFFLINE} high=linucb low=bc offline.updates={n}" for n in (200, 2000)},
    "bc-clean": f"{OFFLINE} high=linucb low=bc offline.updates=2000 {CLEAN}",
    **{f"iql-{g}": f"{OFFLINE} high=linucb low=iql offline.updates=1000 low.gamma={g}" for g in (0.8, 0.9, 0.97)},
    "iql-clean": f"{OFFLINE} high=linucb low=iql offline.updates=1000 {CLEAN}",
    **{f"td3_bc-{g}": f"{OFFLINE} high=linucb low=td3_bc offline.updates=1500 low.gamma={g}" for g in (0.9, 0.97)},
    "td3_bc-clean": f"{OFFLINE} high=linucb low=td3_bc offline.updates=1500 {CLEAN}",
    **{f"pets-{n}": f"{OFFLINE} high=value low=pets offline.updates={n} {CLEAN}" for n in (300, 1000, 3000, 8000)},
    "pets-rest_to_rest": f"{OFFLINE} high=value low=pets offline.updates=3000",
    "pets-caution": f"{OFFLINE} high=value low=pets offline.updates=3000 low.caution=1 {CLEAN}",
    "pets-one_person": f"{ONE_PERSON} high=value low=pets offline.updates=3000 {CLEAN}",
    **{f"hppo-{n}": f"high=ucb low=hppo total_frames={n} eval.every=0" for n in (60_000, 120_000, 240_000)},
    "random-uniform": "high=uniform low=random total_frames=1000 eval.every=0",
}


def run(folder: Path) -> Rows:
    """Train the candidates that are missing, judge them with each fold; return a row for each candidate and fold."""
    for name, words in CANDIDATES.items():
        if not (folder / name / "summary.json").exists():
            settings = f"seed={SEED} eval.seed={SEED} eval.layouts=1000 film=false hydra.run.dir={folder / name}"
            subprocess.run([sys.executable, "run.py", *words.split(), *settings.split()], check=True)
    agents = {name: str(folder / name) for name in CANDIDATES} | {"hppo-linucb": "linucb_hppo"}
    scores = {name: json.loads((folder / name / "summary.json").read_text())["score"] for name in CANDIDATES}
    scores["hppo-linucb"] = hpamdp.load("linucb_hppo").evaluate(episodes=1000, seed=SEED)["score"]
    rows: Rows = []
    for number, people in enumerate(FOLDS):
        settings = {"data.people": people, "data.rest_to_rest": "clean", "offline.updates": 8000, "seed": SEED}
        for found in hpamdp.judge(*agents.values(), data="human", episodes=40, compare=True, **settings):
            name = next(name for name, path in agents.items() if path == found["agent"])
            low, high = found["interval"]
            judged = {"judged": found["return"], "low": low, "high": high, "coverage": found["coverage"]}
            judged |= {column: found[column] for column in ("fitted", "importance", "effective")}
            numbers = {column: round(value, 4) for column, value in {"score": scores[name], **judged}.items()}
            rows.append({"candidate": name, "fold": number, **numbers})
    return rows


def table(rows: Rows) -> str:
    """Return how well each fold and method orders the candidates, and what its best one loses in the simulator."""
    lines = []
    for (fold,), judged in groups(rows, "fold").items():
        for method in METHODS:
            told = [row for row in judged if row[method] != ""]
            if not told:
                continue
            scores, returns = ([row[name] for row in told] for name in ("score", method))
            chosen = max(told, key=lambda row: row[method])
            correlation = stats.spearmanr(scores, returns).statistic
            regret = max(scores) - chosen["score"]
            lines.append([fold, method, f"{correlation:.2f}", f"{regret:.3f}", chosen["candidate"]])
    return markdown_table("fold | method | rank correlation | regret | chosen", lines)


def main(words: Sequence[str]) -> None:
    """Run if asked to, and tabulate."""
    if words[:1] == ["run"]:
        write_tables(HERE, {"judge": run(Path(words[1]).resolve())})
    print(table(read_csv(HERE / "judge.csv")))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
