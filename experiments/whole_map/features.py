"""Compare projections with polynomials as LinUCB's features.

python experiments/whole_map/features.py    prints two tables

The first counts the random decisions after which LinUCB chooses the right boat, if rewards are the planner's scores
with normal noise. The second compares trainings of projections.csv with the same seed; their command is
`python run.py high=linucb low=LEARNER seed=SEED eval.seed=SEED eval.every=0`.
"""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from experiments.study_tables import Rows, groups, markdown_table, mean_of, read_csv
from hpamdp import keys
from hpamdp.analysis.statistics import spread
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.planner import plans_of_options
from hpamdp.policies.high_level.linucb import LinUCB
from hpamdp.specs import PAMDPSpecs

NOISE = 0.5
DECISIONS = (50, 200, 1000, 4000, 8000)
TESTED = 4000  # layouts
FEATURES = {
    "projections": {},
    "polynomial of the goal's offset, degree 5": {"features": "polynomial", "inputs": [14, 15], "degree": 5},
    "polynomial of all entries, degree 2": {"features": "polynomial", "degree": 2},
}


def agreement(env: BoatDockEnv, scores: Tensor, observation: Tensor, num: int, seed: int, settings: dict) -> float:
    """Return in which part of the other layouts LinUCB chooses the right boat after `num` decisions."""
    selector = LinUCB(PAMDPSpecs.from_env(env), memory="all", **settings)
    torch.manual_seed(seed)
    option = torch.randint(2, (num,))
    reward = scores[:num].gather(-1, option.unsqueeze(-1)) + NOISE * torch.randn(num, 1)
    after = {keys.OPTION_RETURN: reward, keys.DECISION_OBSERVATION: observation[:num]}
    selector.learn(TensorDict({keys.OPTION: option, "next": after}, batch_size=[num]))
    mean, _ = selector.predict(observation[-TESTED:])
    return (mean.argmax(-1) == scores[-TESTED:].argmax(-1)).float().mean().item()


def trainings(rows: Rows) -> str:
    """Return a line for each learner: means with polynomials and with projections over the seeds that have both."""
    lines = []
    for (learner,), of_learner in groups(rows, "learner").items():
        kinds = [{row["seed"]: row for row in of_kind} for of_kind in groups(of_learner, "features").values()]
        seeds = sorted(kinds[0].keys() & kinds[-1].keys())
        cells = []
        for name, form in {"score": ".3f", "agreement": ".1%", "weighted": ".1%", "regret": ".3f"}.items():
            cells.append(" → ".join(f"{mean_of([kind[seed] for seed in seeds], name):{form}}" for kind in kinds))
        lines.append([learner, ", ".join(map(str, seeds)), *cells])
    return markdown_table("learner | seeds | score | planner's boat | weighted | regret", lines)


def main() -> None:
    """Measure with five seeds, and print."""
    env = BoatDockEnv(max(DECISIONS) + TESTED, seed=5)
    observation = env.reset()[keys.OBSERVATION]
    scores = plans_of_options(env.options, env._state).score
    lines = [
        [
            name,
            *(
                spread([agreement(env, scores, observation, num, seed, how) for seed in range(5)], 3)
                for num in DECISIONS
            ),
        ]
        for name, how in FEATURES.items()
    ]
    print(markdown_table(f"features | {' | '.join(f'{num:,}' for num in DECISIONS)}", lines))
    print("\n" + trainings(read_csv(Path(__file__).with_name("projections.csv"))))


if __name__ == "__main__":
    main()
