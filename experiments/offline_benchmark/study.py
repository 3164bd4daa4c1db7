"""Describe the data sets of the offline benchmark, and score learners that see nothing else.

python experiments/offline_benchmark/study.py data                       writes data_sets.csv
python experiments/offline_benchmark/study.py run LEARNER DOMAIN SEED... adds rows to results.csv
python experiments/offline_benchmark/study.py                            draws and tabulates the stored files
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from scipy import stats

import hpamdp
from experiments.study_tables import Rows, groups, markdown_table, read_csv, write_tables
from hpamdp import keys
from hpamdp.analysis.statistics import spread
from hpamdp.commands import datasets
from hpamdp.data import minari
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
DOMAINS = ("platform", "goal", "catch_point", "hard_move_4")
NUM_BINS = 20
# Chosen with seed 1 and `eval.seed=7`, then frozen. All other settings are those of the learner on the problem.
ACTOR_CRITIC: dict[str, dict[str, Any]] = {
    "platform": {"offline.updates": 1500},
    "goal": {"offline.updates": 6000, "low.gamma": 0.95, "low.reward_scale": 0.02},
    "catch_point": {"offline.updates": 4000, "low.gamma": 0.95, "low.reward_scale": 0.1},
    "hard_move_4": {"offline.updates": 3000, "low.gamma": 0.95, "low.reward_scale": 0.1, "low.augment": "auto"},
}
MORE: dict[tuple[str, str], dict[str, Any]] = {("iql", "goal"): {"low.expectile": 0.9}}
OTHERS: dict[str, dict[str, Any]] = {"bc": {"offline.updates": 1500}, "pets": {"offline.updates": 4000}}
# Candidates of the judge, the same for every domain.
DEFAULT = {"offline.updates": 5000}
SCALED = {"offline.updates": 3000, "low.gamma": 0.95, "low.reward_scale": 0.1, "low.augment": "auto"}
CANDIDATES: dict[str, dict[str, dict[str, Any]]] = {
    "iql": {
        "default": DEFAULT,
        "scaled": SCALED,
        "expectile": {**SCALED, "low.expectile": 0.9},
        "temperature": {**SCALED, "low.temperature": 3.0},
    },
    "td3_bc": {"default": DEFAULT, "scaled": SCALED, "weight": {**SCALED, "low.behaviour_weight": 0.4}},
    "bc": {"short": OTHERS["bc"], "default": DEFAULT},
    "pets": {"plain": OTHERS["pets"], "cautious": {**OTHERS["pets"], "low.caution": 1.0}},
}


def main(words: Sequence[str]) -> int:
    """Do what the words ask for; without words, draw the figure and print the tables."""
    if words[:1] == ["data"]:
        write_tables(HERE, {"data_sets": [described(*name.split("/")[1:]) for name in datasets.names()]})
    elif words[:1] == ["run"]:
        low, domain, *seeds = words[1:]
        add_rows(low, domain, map(int, seeds), settings_of(low, domain), "simulator")
    else:
        data, rows, judged = (read_csv(HERE / f"{name}.csv") for name in ("data_sets", "results", "judge"))
        draw(data)
        print("\n\n".join([results_table(rows, judged), judge_table(judged), data_table(data)]))
    return 0


def described(domain: str, name: str) -> dict[str, Any]:
    """Return the figures of a data set, and the numbers of its episodes by their returns."""
    rows = datasets.transitions(domain, name.removesuffix("-v0"))
    is_last = rows["next", keys.DONE].squeeze(-1).numpy()
    sums = rows["next", keys.REWARD].squeeze(-1).double().cumsum(0).numpy()[is_last]
    returns = np.diff(sums, prepend=0.0)
    counts, edges = np.histogram(returns, NUM_BINS)
    return {
        "data_set": f"hpamdp/{domain}/{name}",
        "episodes": len(returns),
        "steps": len(rows),
        "mean_return": round(float(returns.mean()), 3),
        "lowest": round(float(edges[0]), 3),
        "highest": round(float(edges[-1]), 3),
        "histogram": " ".join(map(str, counts)),
        "actions": " ".join(map(str, np.bincount(rows[keys.DISCRETE].numpy()))),
        "checksum": minari.checksum(rows),
    }


def mixed(domain: str) -> str:
    """Return the name of the data set from which the learners learn."""
    return f"hpamdp/{domain}/mixed-v0"


def settings_of(low: str, domain: str) -> dict[str, Any]:
    """Return the settings of a learner that were chosen with the simulator."""
    return {**(OTHERS.get(low) or ACTOR_CRITIC[domain]), **MORE.get((low, domain), {})}


def candidates(low: str, domain: str) -> dict[str, dict[str, Any]]:
    """Return the settings of the candidates by their names; `tuned`, unless it repeats others, is the simulator's."""
    named, tuned = CANDIDATES[low], settings_of(low, domain)
    return named if tuned in named.values() else {**named, "tuned": tuned}


def add_rows(low: str, domain: str, seeds: Iterable[int], settings: Mapping[str, Any], chosen_by: str) -> None:
    """Score settings with each seed, and add the rows to results.csv."""
    for seed in seeds:
        row = {"data_set": mixed(domain), "learner": low, "chosen_by": chosen_by, "seed": seed}
        row |= scored(low, domain, settings, seed=seed, eval_seed=seed)
        write_tables(HERE, {"results": [*read_csv(HERE / "results.csv"), row]})


def scored(
    low: str, domain: str, settings: Mapping[str, Any], *, seed: int, eval_seed: int, **more: Any
) -> dict[str, Any]:
    """Train a learner on the `mixed` data set of a domain and return its figures.

    Args:
        low: the learner.
        domain: the domain.
        settings: of the learner and of the run.
        seed: of the training.
        eval_seed: of the episodes.
        more: further arguments of `hpamdp.train`.
    """
    began = time.process_time()
    agent = hpamdp.train(
        domain.removesuffix("_4"),
        mode="offline",
        high=None,
        low=low,
        seed=seed,
        progress=False,
        film=False,
        **{
            "data": "minari",
            "data.dataset": mixed(domain),
            "offline.eval_every": 0,
            "eval.layouts": 1,
            **settings,
            **more,
        },
    )
    seconds = time.process_time() - began
    num = 300 if low == "pets" else 1000
    figures = agent.evaluate(episodes=num, seed=eval_seed)
    return {
        "updates": settings["offline.updates"],
        "score": round(figures["score"], 4),
        "success": round(figures["success"], 4),
        "episodes": num,
        "cpu_s": round(seconds, 1),
    }


def normalised(row: dict[str, Any]) -> float:
    """Return a row's score, from 0 of random actions to 1 of the best learner with steps of its own."""
    settings = datasets.DOMAINS[row["data_set"].split("/")[1]]
    low, high = settings["random_score"], settings["best_score"]
    return (row["score"] - low) / (high - low)


def results_table(rows: Rows, judged: Rows) -> str:
    """Return normalised scores, two lines for each domain: with settings by the simulator, and by the judge."""
    lines = []
    for domain in DOMAINS:
        for chosen_by in ("simulator", "judge"):
            cells = (result(low, domain, chosen_by, rows, judged) for low in CANDIDATES)
            lines.append((domain, chosen_by, *cells))
    return markdown_table(f"domain | settings by | {' | '.join(CANDIDATES)}", lines)


def result(low: str, domain: str, chosen_by: str, rows: Rows, judged: Rows) -> str:
    """Return the normalised scores of a learner in words, with the number of seeds unless it is ten."""
    same = {"data_set": mixed(domain), "learner": low, "chosen_by": chosen_by}
    scores = [normalised(row) for row in rows if same.items() <= row.items()]
    if scores:
        return f"{spread(scores)}{'' if len(scores) == 10 else f' ({len(scores)})'}"
    name = chosen_of([row for row in judged if (row["domain"], row["learner"]) == (domain, low)])["settings"]
    return "the same" if candidates(low, domain)[name] == settings_of(low, domain) else "not run"


def chosen_of(judged: Rows) -> dict[str, Any]:
    """Return the candidate that the judge chooses; the one with the simulator's settings may not be chosen."""
    return max((row for row in judged if row["settings"] != "tuned"), key=lambda row: row["judged"])


def judge_table(judged: Rows) -> str:
    """Return what the judge chooses in each domain, and what its choices lose, among all and one learner's."""
    lines = []
    for (domain,), rows in groups(judged, "domain").items():
        scores = [score_of(row) for row in rows]
        correlation = stats.spearmanr(scores, [row["judged"] for row in rows]).statistic
        best, chosen = max(rows, key=score_of), chosen_of(rows)
        regrets = {low: regret([row for row in rows if row["learner"] == low]) for low in CANDIDATES}
        worst = max(regrets, key=lambda low: regrets[low])
        names = (f"{each['learner']} {each['settings']}, {score_of(each):.3f}" for each in (chosen, best))
        most = f"{regrets[worst]:.3f} ({worst})"
        lines.append((domain, *names, f"{correlation:.2f}", f"{regret(rows):.3f}", most))
    head = "domain | the judge's choice | best | rank correlation | regret | largest of one learner"
    return markdown_table(head, lines)


def regret(judged: Rows) -> float:
    """Return what the judge's choice loses to the best candidate."""
    return max(map(score_of, judged)) - score_of(chosen_of(judged))


def score_of(row: dict[str, Any]) -> float:
    """Return the normalised score of a candidate."""
    return normalised({"data_set": mixed(row["domain"]), **row})


def data_table(data: Rows) -> str:
    """Return the steps and the mean return of the data sets, a line for each domain."""
    parts = {tuple(row["data_set"].removesuffix("-v0").split("/")[1:]): row for row in data}
    names = list(dict.fromkeys(part for _, part in parts))
    return markdown_table(
        f"steps, mean return | episodes | {' | '.join(names)}",
        [
            (
                domain,
                f"{parts[domain, 'random']['episodes']:,}",
                *(
                    f"{row['steps']:,}, {row['mean_return']:.2f}" if (row := parts.get((domain, part))) else ""
                    for part in names
                ),
            )
            for domain in datasets.DOMAINS
        ],
    )


def draw(data: Rows) -> None:
    """Draw the returns of the episodes of each data set."""
    domains = list(datasets.DOMAINS)
    figure, axes = plt.subplots(1, len(domains), figsize=(3.2 * len(domains), 2.6), layout="constrained")
    for axis, domain in zip(axes, domains, strict=True):
        for row in [row for row in data if f"/{domain}/" in row["data_set"]]:
            counts = np.array([int(each) for each in row["histogram"].split()])
            axis.stairs(
                counts / counts.sum(),
                np.linspace(row["lowest"], row["highest"], NUM_BINS + 1),
                label=row["data_set"].split("/")[2],
            )
        axis.set(title=domain, xlabel="return", yscale="log")
        axis.legend(fontsize=5)
    axes[0].set_ylabel("fraction of the episodes")
    figure.savefig(HERE / "returns.png", dpi=120)
    plt.close(figure)


if __name__ == "__main__":
    minari.load, datasets.transitions = cache(minari.load), cache(datasets.transitions)
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
