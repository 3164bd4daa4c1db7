"""DecisionTracker: the semi-MDP view of an episode."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import check_env_specs

from hpamdp import keys
from hpamdp.env.boatdock import BoatDockEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.random import Random
from hpamdp.specs import PAMDPSpecs


def random_agent(env):
    specs = PAMDPSpecs.from_env(env)
    selector = Uniform(specs) if specs.num_options else None
    return HierarchicalAgent(selector, [Random(specs) for _ in range(max(1, specs.num_options))], specs)


@pytest.mark.parametrize("controller", ["choose", "congruent", "random"])
def test_tracked_environment_has_clean_specs(controller):
    check_env_specs(with_decisions(BoatDockEnv(3, controller=controller)))


def account(rows: TensorDict, gamma: float) -> None:
    """Follow one environment's rows and hold every key of the tracker against a count of our own."""
    is_due, total, steps, decided_at = True, 0.0, 0, rows[0][keys.OBSERVATION]
    for row in rows:
        assert row[keys.IS_DECISION].item() == is_due
        if is_due:
            total, steps, decided_at, option = 0.0, 0, row[keys.OBSERVATION], row[keys.OPTION]
        assert row[keys.OPTION] == option, "the option changed inside an episode"
        total += gamma**steps * row["next", keys.REWARD].item()
        steps += 1
        is_due = row["next", keys.DONE].item()
        assert row["next", keys.IS_DECISION].item() == is_due
        assert row["next", keys.OPTION_STEPS].item() == steps
        assert row["next", keys.OPTION_RETURN].item() == pytest.approx(total, abs=1e-5)
        assert torch.equal(row["next", keys.DECISION_OBSERVATION], decided_at)


@pytest.mark.parametrize("gamma", [1.0, 0.9])
def test_options_are_accounted_right_across_collected_batches(gamma):
    torch.manual_seed(0)
    env = with_decisions(BoatDockEnv(4), gamma)
    collector = Collector(
        env,
        random_agent(env).policy,
        frames_per_batch=4 * 3,
        total_frames=4 * 60,
        auto_register_policy_transforms=False,
    )
    rows = torch.cat([batch.clone() for batch in collector], 1)
    collector.shutdown()
    assert rows.shape == (4, 60)
    for environment in rows:
        account(environment, gamma)


def test_decisions_of_one_environment_survive_the_resets_of_others():
    torch.manual_seed(1)
    env = with_decisions(BoatDockEnv(5))
    rows = env.rollout(40, random_agent(env).policy, break_when_any_done=False)
    assert rows["next", keys.DONE].any(1).all()
    for environment in rows:
        account(environment, 1.0)
