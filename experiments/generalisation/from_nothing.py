"""Score PETS that begins every session untrained, as a floor: it knows no boat but the session's own.

python experiments/generalisation/from_nothing.py    writes from_nothing.csv: a row for each trip, in six minutes
"""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import torch
import torchrl
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import step_mdp

from experiments.study_tables import write_tables
from hpamdp import keys
from hpamdp.env.boatdock_unseen.environment import UnseenBoatsEnv
from hpamdp.messages import exit_code
from hpamdp.policies.low_level.pets.learner import PETS
from hpamdp.specs import PAMDPSpecs

HERE = Path(__file__).resolve().parent
SESSIONS = 100
EVALUATION_SEED = 99
# As on boats with many presses, but for the warm-up, which is short, and plans without noise. Every press counts here.
SETTINGS = {"gamma": 0.97, "warmup_steps": 8, "parameter_noise": 0.0, "planning_precision": "float32"}


def played_sessions(env: UnseenBoatsEnv, learners: list[PETS]) -> tuple[Tensor, Tensor]:
    """Return scores and presses, `[N, trips]` each, of learners that play one session each and learn from it."""
    td = env.reset()
    while not td[keys.DONE].all():
        stepped = env.step(torch.cat([learner.policy(td[row : row + 1]) for row, learner in enumerate(learners)]))
        for row, learner in enumerate(learners):
            learn(learner, stepped[row : row + 1].unsqueeze(1), is_over=bool(td[keys.DONE][row]))
        td = step_mdp(stepped)
    played = env.played()
    return played["trip_score"], played["trip_presses"]


def learn(learner: PETS, step: TensorDictBase, *, is_over: bool) -> None:
    """Let a learner learn from a step `[1, 1]` of its session, unless that is over."""
    if not is_over:
        learner.learn(step, torch.ones(1, 1, dtype=torch.bool))


def main() -> int:
    """Play the sessions, each with a learner of its own."""
    torchrl.logger.setLevel(logging.WARNING)  # it would log every replay buffer
    torch.set_num_threads(1)
    torch.manual_seed(EVALUATION_SEED)
    env = UnseenBoatsEnv(SESSIONS)
    env.seed_evaluation(EVALUATION_SEED)
    specs = PAMDPSpecs.from_env(env)
    scores, presses = played_sessions(env, [PETS(specs, **SETTINGS) for _ in range(SESSIONS)])
    rows = [
        {
            "family": "turned",
            "boats": 1,
            "player": "from_nothing",
            "trip": trip,
            "score": round(score.mean().item(), 3),
            "standard_error": round(score.std().item() / SESSIONS**0.5, 3),
            "presses": round(number.float().mean().item(), 2),
        }
        for trip, (score, number) in enumerate(zip(scores.unbind(1), presses.unbind(1), strict=True), start=1)
    ]
    write_tables(HERE, {"from_nothing": rows})
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
