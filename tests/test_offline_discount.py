"""The discount of offline learners, chosen from people's presses alone."""

from pathlib import Path

import pytest
import torch
from scripts import load_script

from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.specs import PAMDPSpecs

SCRIPT = Path(__file__).resolve().parent.parent / "experiments/offline/discount.py"


@pytest.fixture(scope="module")
def discount():
    return load_script(SCRIPT)


def row(learner, gamma, fold, correlation):
    return {"learner": learner, "gamma": gamma, "fold": fold, "rank_correlation": correlation}


def test_the_discount_with_the_best_mean_over_folds_is_chosen(discount):
    rows = [row("iql", 0.9, 0, 0.6), row("iql", 0.9, 1, 0.2), row("iql", 0.99, 0, 0.45), row("iql", 0.99, 1, 0.45)]
    rows += [row("td3_bc", 0.9, 0, 0.3), row("td3_bc", 0.99, 0, 0.1)]
    assert discount.chosen(rows) == {"iql": 0.99, "td3_bc": 0.9}
    lines = discount.table(rows).splitlines()
    assert lines[2] == "| 0.9 | 0.400 (0.200 to 0.600) | 0.300 (0.300 to 0.300) |"


def test_every_person_is_held_out_once_and_never_split(discount):
    person = torch.tensor([0, 0, 3, 5, 5, 5, 1])
    masks = torch.stack([*discount.folds(person, 3)])
    assert masks.sum(0).eq(1).all()
    for each in person.unique():
        assert len(masks[:, person == each].unique(dim=1)[0]) == 1


def test_values_of_held_out_presses_follow_the_rewards_that_were_learned(discount):
    """The last press of each episode here is rewarded by its duration."""
    env = BoatDockEnv(64, controller="random", seed=0)
    rows = env.rollout(4, break_when_any_done=False).flatten()
    rows["next", "terminated"] = torch.ones_like(rows["next", "terminated"])
    own = rows["action", "parameters"].gather(-1, rows["action", "discrete"].unsqueeze(-1))
    rows["next", "reward"] = own
    learner = discount.fitted("iql", 0.9, PAMDPSpecs.from_env(env), rows[:192], 60, 0)
    found = discount.values(learner, rows[192:])
    assert torch.corrcoef(torch.stack([found, own[192:, 0]]))[0, 1] > 0.5
