"""Choose the discount of the offline learners from people's presses alone, without the simulator's scores.

python experiments/offline/discount.py              fits each learner with each discount and writes discount.csv
python experiments/offline/discount.py --show       prints the stored table

A learner is fitted to the presses of some people. Its critic then ranks the presses of the others, who are split into
folds. The discount whose values rank the held-out presses most like the scores of their episodes is chosen: Spearman's
rank correlation, mean over the folds. Values of several discounts differ in their scale, but a rank has none.

Paine et al. 2020, *Hyperparameter Selection for Offline Reinforcement Learning*, arXiv 2007.09055, choose settings by
fitted values, too. They compare the values of initial states, which are comparable under one discount alone.

A clone (`bc`) has no discount in its loss, so none is chosen for it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch
from scipy import stats
from tensordict import TensorDict
from torch import Tensor

from experiments.study_tables import Rows, groups, markdown_table, mean_of, read_csv, write_tables
from hpamdp.data.human.demonstrations import HumanDemonstrations
from hpamdp.data.human.episodes import score
from hpamdp.data.human.released_file import read
from hpamdp.data.row_checks import TRAJECTORY
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.messages import exit_code
from hpamdp.policies.low_level.iql import IQL
from hpamdp.policies.low_level.td3_bc import TD3BC
from hpamdp.specs import PAMDPSpecs

HERE = Path(__file__).resolve().parent
LEARNERS: dict[str, type[IQL] | type[TD3BC]] = {"iql": IQL, "td3_bc": TD3BC}
RECIPES = {"iql": 0.85, "td3_bc": 0.9}  # chosen by scores of the simulator
DISCOUNTS = (0.8, 0.85, 0.9, 0.95, 0.97, 0.99)
NUM_FOLDS = 3
UPDATES = 1000


def fitted(name: str, gamma: float, specs: PAMDPSpecs, rows: TensorDict, updates: int, seed: int) -> IQL | TD3BC:
    """Return a learner after updates from rows `[N]` alone."""
    torch.manual_seed(seed)
    learner = LEARNERS[name](specs, gamma=gamma)
    learner.add_demonstrations(rows.unsqueeze(0), torch.ones(1, len(rows), dtype=torch.bool))
    learner.update(updates)
    return learner


@torch.no_grad()
def values(learner: IQL | TD3BC, rows: TensorDict) -> Tensor:
    """Return the smaller of the critics' values of the actions in rows `[N]`."""
    stored = learner.transitions(rows.unsqueeze(0)).squeeze(0)
    return learner.critics.of_discrete(stored["state"], stored["discrete"], stored["unit"]).amin(0)


def folds(person: Tensor, num: int) -> Iterator[Tensor]:
    """Yield which rows are held out, bool `[N]`: every person's rows once, and all rows of a person together."""
    for fold in range(num):
        yield person % num == fold


def correlations(
    specs: PAMDPSpecs, rows: TensorDict, person: Tensor, scores: Tensor, *, updates: int = UPDATES
) -> Iterator[dict[str, object]]:
    """Yield learner, discount, fold and rank correlation of values and scores on the held-out rows.

    Args:
        specs: of the problem.
        rows: presses `[N]`, as the environment returns them.
        person: who pressed, `[N]`.
        scores: of each press's episode, `[N]`.
        updates: of each learner.
    """
    for name in LEARNERS:
        for gamma in DISCOUNTS:
            for fold, is_held_out in enumerate(folds(person, NUM_FOLDS)):
                learner = fitted(name, gamma, specs, rows[~is_held_out], updates, fold)
                found = stats.spearmanr(values(learner, rows[is_held_out]).numpy(), scores[is_held_out].numpy())
                yield {"learner": name, "gamma": gamma, "fold": fold, "rank_correlation": round(float(found[0]), 4)}


def chosen(rows: Rows) -> dict[str, float]:
    """Return the discount with the highest mean rank correlation, by learner."""
    best = {}
    for (name,), of_learner in groups(rows, "learner").items():
        means = {
            gamma: mean_of(of_fold, "rank_correlation") for (gamma,), of_fold in groups(of_learner, "gamma").items()
        }
        best[name] = max(means, key=means.__getitem__)
    return best


def table(rows: Rows) -> str:
    """Return a line for each discount: the rank correlation of each learner, mean and smallest to largest fold."""
    names = list(dict.fromkeys(row["learner"] for row in rows))
    lines = []
    for (gamma,), same in groups(rows, "gamma").items():
        columns = []
        for name in names:
            of_folds = [row for row in same if row["learner"] == name]
            found = [row["rank_correlation"] for row in of_folds]
            columns.append(
                f"{mean_of(of_folds, 'rank_correlation'):.3f} ({min(found):.3f} to {max(found):.3f})" if found else ""
            )
        lines.append([f"{gamma:g}", *columns])
    return markdown_table(" | ".join(["discount", *names]), lines)


def main(words: Sequence[str]) -> None:
    """Fit, store, tabulate. One learner serves both boats, which all observations show."""
    if "--show" not in words:
        env = BoatDockEnv(1, controller="random")
        rows = HumanDemonstrations(env).batch.squeeze(0)
        episodes = read(one_frame=True)
        episode = rows[TRAJECTORY]
        person, scores = episodes.episodes["person"][episode], score(episodes)[episode]
        found = correlations(PAMDPSpecs.from_env(env), rows, person, scores)
        write_tables(HERE, {"discount": [*found]})
    stored = read_csv(HERE / "discount.csv")
    print(table(stored))
    for name, gamma in chosen(stored).items():
        print(f"\n{name}: {gamma:g}, the recipe has {RECIPES[name]:g}")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
