"""OptionChoiceEnv makes an ordinary environment of the high level."""

import pytest
import torch
from torchrl.envs import check_env_specs
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from toy_options import Crossing, WholeStep, steppers

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.env.option_choice import OptionChoiceEnv
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner
from hpamdp.policies.high_level.fixed import Fixed
from hpamdp.policies.low_level.random import RandomPolicy
from hpamdp.specs import PAMDPSpecs


class Presser(torch.nn.Module):
    """A deterministic policy: the fuel decides the key, the distance to the goal the duration."""

    def forward(self, td):
        distance = td[keys.OBSERVATION][..., -2:].norm(dim=-1)
        duration = (0.5 + 0.5 * distance.clamp(max=1.0)).unsqueeze(-1).expand(-1, 3)
        discrete = (td[keys.OBSERVATION][..., 12] * 7).long() % 3
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": duration}})


def make(num_envs: int) -> OptionChoiceEnv:
    return OptionChoiceEnv(Presser(), BoatDockEnv(num_envs, seed=3))


def test_all_tensors_are_as_the_specs_say():
    env = BoatDockEnv(4)
    check_env_specs(OptionChoiceEnv(RandomPolicy(PAMDPSpecs.from_env(env)), env))
    check_env_specs(with_decisions(OptionChoiceEnv(WholeStep(), Crossing(4, start=6.0))))


def test_every_step_is_one_whole_episode():
    rows = make(6).rollout(8, break_when_any_done=False)
    assert rows["next", keys.DONE].all() and rows["next", keys.TERMINATED].all()
    assert (rows["next", keys.OUTCOME] > 0).all()
    assert not torch.equal(rows[keys.OBSERVATION][:, 0], rows[keys.OBSERVATION][:, 1])


@pytest.mark.parametrize("option", [0, 1])
def test_the_reward_is_the_return_of_the_same_episode_played_step_by_step(option):
    env = make(50)
    td = env.reset()
    reward = env.step(td.set(keys.OPTION, torch.full((50,), option)))["next", keys.REWARD]

    presses = with_decisions(BoatDockEnv(50, seed=3))
    specs = PAMDPSpecs.from_env(presses)
    learners = []
    for _ in range(2):
        learner = Learner(specs)
        learner.policy = Presser()
        learner.policy.in_keys = [keys.OBSERVATION]
        learner.policy.out_keys = [keys.DISCRETE, keys.PARAMETERS]
        learners.append(learner)
    agent = HierarchicalAgent(Fixed(specs, option=option), learners, specs)
    rows = presses.rollout(25, agent.policy, break_when_any_done=False)
    first_end = rows["next", keys.DONE].squeeze(-1).int().argmax(1)
    expected = rows["next", keys.OPTION_RETURN][torch.arange(50), first_end]
    torch.testing.assert_close(reward, expected)


def test_any_environment_with_options_will_do():
    option = 0

    class Hurried(Crossing):
        max_steps = 10

    env = OptionChoiceEnv(WholeStep(), Hurried(40, start=6.0, seed=1))
    after = env.step(env.reset().set(keys.OPTION, torch.full((40,), option)))["next"]

    specs = PAMDPSpecs.from_env(Hurried(1))
    single = with_decisions(Hurried(40, start=6.0, seed=1))
    rows = single.rollout(10, steppers(Fixed(specs, option=option), specs).policy, break_when_any_done=False)
    first_end = rows["next", keys.DONE].squeeze(-1).int().argmax(1)
    arrived = rows["next", keys.TERMINATED][torch.arange(40), first_end]
    assert arrived.any() and not arrived.all()
    assert torch.equal(after[keys.REWARD], arrived.float())
    assert torch.equal(env.results(after)["success"], arrived.squeeze(-1))
    assert after[keys.TERMINATED].all() and not after[keys.TRUNCATED].any()


@pytest.mark.parametrize("outside", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_the_low_level_acts_greedily_while_the_options_are_explored(outside):
    seen = set()

    class Listening(Presser):
        def forward(self, td):
            seen.add(exploration_type())
            return super().forward(td)

    env = OptionChoiceEnv(Listening(), BoatDockEnv(3))
    with set_exploration_type(outside):
        env.rollout(2)
        assert exploration_type() == outside
    assert seen == {ExplorationType.DETERMINISTIC}


def test_it_keeps_the_frameworks_contract():
    env, boats = make(5), BoatDockEnv(5, seed=3)
    assert isinstance(env, PAMDPEnv) and env.has_choice and env.max_steps == 1
    assert env.option_names == boats.option_names and env.result_keys == boats.result_keys
    assert (env.fixed_episodes(4) == boats.fixed_episodes(4)).all()
    rows = env.rollout(3, break_when_any_done=False)
    assert set(env.results(rows[:, -1]["next"])) == {"outcome", "fuel", "score", "success"}
    assert list(env.parameters()) == []


def test_a_restored_state_continues_as_the_original():
    env, other = make(5), make(5)
    env.rollout(3, break_when_any_done=False)
    other.set_env_state(env.env_state())
    expected = env.reset()[keys.OBSERVATION]
    torch.testing.assert_close(other.reset()[keys.OBSERVATION], expected)


def test_an_environment_without_a_choice_is_refused():
    with pytest.raises(ValueError, match="no option to choose"):
        OptionChoiceEnv(Presser(), BoatDockEnv(2, controller="random"))
