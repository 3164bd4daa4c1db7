"""ControllerChoiceEnv: the high level as an ordinary environment."""

import pytest
import torch
from torchrl.envs import check_env_specs

from hpamdp import keys
from hpamdp.env.boatdock import BoatDockEnv
from hpamdp.env.choice import ControllerChoiceEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner
from hpamdp.policies.high_level.fixed import Fixed
from hpamdp.policies.low_level.random import RandomPolicy
from hpamdp.specs import PAMDPSpecs


class Presser(torch.nn.Module):
    """Press key 0 for as long as the observation's goal lies away: a policy that draws nothing."""

    def forward(self, td):
        distance = td[keys.OBSERVATION][..., -2:].norm(dim=-1)
        duration = (0.5 + 0.5 * distance.clamp(max=1.0)).unsqueeze(-1).expand(-1, 3)
        key = (td[keys.OBSERVATION][..., 12] * 7).long() % 3
        return td.update({keys.ACTION: {"key": key, "duration": duration}})


def make(num_envs: int) -> ControllerChoiceEnv:
    return ControllerChoiceEnv(Presser(), BoatDockEnv(num_envs, seed=3))


def test_specs_are_clean():
    env = BoatDockEnv(4)
    check_env_specs(ControllerChoiceEnv(RandomPolicy(PAMDPSpecs.from_env(env)), env))


def test_every_step_is_one_whole_episode():
    rows = make(6).rollout(8, break_when_any_done=False)
    assert rows["next", keys.DONE].all() and rows["next", keys.TERMINATED].all()
    assert (rows["next", keys.OUTCOME] > 0).all()
    assert not torch.equal(rows[keys.OBSERVATION][:, 0], rows[keys.OBSERVATION][:, 1])


@pytest.mark.parametrize("option", [0, 1])
def test_reward_is_the_return_of_the_episode_played_press_by_press(option):
    env = make(50)
    td = env.reset()
    reward = env.step(td.set(keys.OPTION, torch.full((50,), option)))["next", keys.REWARD]

    presses = with_decisions(BoatDockEnv(50, seed=3))
    specs = PAMDPSpecs.from_env(presses)
    learners = []
    for _ in range(2):
        learner = Learner(specs)
        learner.policy = Presser()
        learner.policy.in_keys, learner.policy.out_keys = [keys.OBSERVATION], [keys.KEY, keys.DURATION]
        learners.append(learner)
    agent = HierarchicalAgent(Fixed(specs, option=option), learners, specs)
    rows = presses.rollout(25, agent.policy, break_when_any_done=False)
    first_end = rows["next", keys.DONE].squeeze(-1).int().argmax(1)
    expected = rows["next", keys.OPTION_RETURN][torch.arange(50), first_end]
    torch.testing.assert_close(reward, expected)


def test_an_environment_without_a_choice_is_refused():
    with pytest.raises(ValueError, match="choose"):
        ControllerChoiceEnv(Presser(), BoatDockEnv(2, controller="congruent"))
