"""A learner's policy may carry a key of its own from step to step, wherever it acts."""

import pytest
import torch
from tensordict.nn import TensorDictModuleBase

from hpamdp import keys
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.env.option_choice import OptionChoiceEnv
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.specs import PAMDPSpecs

COUNT = "count"


class CountingPolicy(TensorDictModuleBase):
    """Idles, and counts the steps since its option began, in tens for the second learner."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.in_keys = [keys.OBSERVATION, keys.IS_DECISION, COUNT]
        self.out_keys = [keys.DISCRETE, keys.PARAMETERS, COUNT]
        self.step = step
        self.counts = []

    def forward(self, td):
        shape = td.batch_size
        held = td.get(COUNT, None)
        zeros = torch.zeros(shape, dtype=torch.long)
        begins = td.get(keys.IS_DECISION, None)
        if held is None:
            held = zeros
        elif begins is not None:
            held = torch.where(begins.reshape(shape), 0, held)
        count = held + self.step
        self.counts.append(count)
        td.update({keys.ACTION: {"discrete": zeros, "parameters": torch.full((*shape, 3), 1e-3)}})
        return td.set(COUNT, count)


class Counting(Learner):
    def __init__(self, specs: PAMDPSpecs, step: int) -> None:
        super().__init__(specs)
        self.policy = CountingPolicy(step)


def make(num_learners: int, *, is_shared: bool = False) -> tuple[HierarchicalAgent, BoatDockEnv]:
    torch.manual_seed(0)
    env = BoatDockEnv(20, controller="choose")
    specs = PAMDPSpecs.from_env(env)
    learners = [Counting(specs, 10**i) for i in range(num_learners)]
    return HierarchicalAgent(Uniform(specs), learners, specs, is_shared=is_shared), env


@pytest.mark.parametrize("is_shared", [False, True])
def test_the_state_of_a_single_learners_policy_lasts_an_episode(is_shared):
    agent, env = make(1, is_shared=is_shared)
    rolled = with_decisions(env).rollout(30, agent.policy, break_when_any_done=False)
    since = rolled["next", keys.EPISODE_STEPS].squeeze(-1)
    assert torch.equal(rolled[COUNT], since) and since.max() == 25


def test_each_options_policy_keeps_the_state_of_its_own_environments():
    agent, env = make(2)
    rolled = with_decisions(env).rollout(30, agent.policy, break_when_any_done=False)
    since = rolled["next", keys.EPISODE_STEPS].squeeze(-1)
    assert torch.equal(rolled[COUNT], since * 10 ** rolled[keys.OPTION])
    assert len(rolled[keys.OPTION].unique()) == 2


def test_the_state_lasts_an_episode_that_is_one_step_of_a_frozen_low_level():
    agent, env = make(1)
    with_decisions(OptionChoiceEnv(agent.router, env)).rollout(1, agent.selector)
    counts = torch.stack(agent.learners[0].policy.counts[-25:])
    assert torch.equal(counts[:, 0], torch.arange(1, 26))
