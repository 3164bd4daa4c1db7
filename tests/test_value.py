"""The selector that asks the learners what they expect, and PETS as a learner that can say."""

from functools import partial

import pytest
import torch
from conftest import global_generators_unmoved
from tensordict import TensorDict
from test_pets import OPTIONS
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import States
from hpamdp.policies.high_level.value import Value
from hpamdp.policies.low_level.hyar import HyAR
from hpamdp.policies.low_level.paddpg import PADDPG
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.policies.low_level.pets.learner import PETS
from hpamdp.policies.low_level.td3_bc import TD3BC
from hpamdp.specs import PAMDPSpecs

CPU = torch.device("cpu")
BOATS = PAMDPSpecs.from_env(BoatDockEnv(1, controller="choose"))
GREEDY = ExplorationType.DETERMINISTIC


class Expects(nn.Module):
    """Expects of option i the observation's entry i."""

    def __init__(self):
        super().__init__()
        self.asked = []

    def forward(self, states):
        self.asked.append(len(states.observation))
        return states.observation[:, :2]


def selector(epsilon=0.0) -> Value:
    chosen = Value(BOATS, epsilon=epsilon)
    chosen.option_values = Expects()
    return chosen


def seen(values, is_decision=None) -> TensorDict:
    values = torch.tensor(values)
    due = torch.ones(len(values), dtype=torch.bool) if is_decision is None else torch.tensor(is_decision)
    return TensorDict({keys.OBSERVATION: values, keys.IS_DECISION: due.unsqueeze(-1)}, [len(values)])


def test_the_option_of_which_its_learner_expects_most_is_chosen():
    td = seen([[1.0, 2.0], [3.0, -1.0], [0.0, 0.5]])
    for mode in (GREEDY, ExplorationType.RANDOM):
        with set_exploration_type(mode):
            assert selector()(td.clone())[keys.OPTION].tolist() == [1, 0, 1]


def test_learners_are_asked_only_where_a_decision_is_due():
    chosen = selector()
    td = seen([[1.0, 2.0]] * 4, [True, False, False, True]).set(keys.OPTION, torch.zeros(4, dtype=torch.long))
    assert chosen(td)[keys.OPTION].tolist() == [1, 0, 0, 1]
    assert chosen.option_values.asked == [2]


def test_learners_are_not_asked_about_episodes_that_have_ended():
    chosen = selector()
    td = seen([[1.0, 2.0]] * 4).set(keys.DONE, torch.tensor([[True], [False], [True], [False]]))
    assert chosen(td.clone())[keys.OPTION][[1, 3]].tolist() == [1, 1]
    chosen(td.set(keys.DONE, torch.ones(4, 1, dtype=torch.bool)))
    assert chosen.option_values.asked == [2]


def test_in_an_episode_that_has_ended_the_first_possible_option_is_played_on():
    td = seen([[1.0, 2.0]] * 2).set(keys.DONE, torch.tensor([[True], [True]]))
    td.set(keys.OPTION_MASK, torch.tensor([[False, True], [True, True]]))
    assert selector()(td)[keys.OPTION].tolist() == [1, 0]


def test_after_a_truncation_learners_bootstrap_from_the_best_option():
    env = with_decisions(BoatDockEnv(3, controller="choose"), 1.0, 2)
    agent = HierarchicalAgent(selector(), [PDQN(BOATS) for _ in range(2)], BOATS)
    agent.selector.option_values = Expects()
    with torch.no_grad():
        batch = env.rollout(2, agent.policy)
    after = batch["next"]
    after[keys.OPTION_ENDED][:, -1], after[keys.DONE][:, -1] = True, True
    after[keys.TERMINATED][:, -1] = torch.tensor([[False], [False], [True]])
    after[keys.OBSERVATION][:, -1, :2] = torch.tensor([[0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    agent.selector.option_values.asked.clear()
    assert agent.next_options.with_next_option(batch)[keys.NEXT_OPTION][:2, -1].tolist() == [1, 0]
    assert agent.selector.option_values.asked == [2], "after a termination no value counts"


def test_of_equal_options_exploring_takes_a_random_one():
    torch.manual_seed(0)
    values = [[torch.inf, torch.inf]] * 400
    assert 150 < selector()(seen(values))[keys.OPTION].sum() < 250


def test_epsilon_is_the_share_of_random_options():
    torch.manual_seed(0)
    chosen = selector(epsilon=0.5)(seen([[0.0, 1.0]] * 2000))[keys.OPTION]
    assert 0.2 < (chosen == 0).float().mean() < 0.3


def make_agent(is_shared: bool) -> HierarchicalAgent:
    torch.manual_seed(0)
    specs = [BOATS.with_option_observed()] if is_shared else [BOATS.of_option(i) for i in range(2)]
    learners = [PETS(own, device=CPU, **OPTIONS) for own in specs]
    return HierarchicalAgent(Value(BOATS, epsilon=0.0), learners, BOATS, is_shared=is_shared)


@pytest.mark.parametrize("is_shared", [False, True])
def test_plans_choose_the_boat(is_shared):
    agent = make_agent(is_shared)
    env = with_decisions(BoatDockEnv(16, controller="choose"))
    torch.manual_seed(0)
    rolled = env.rollout(8, agent.policy, break_when_any_done=False)
    assert set(rolled[keys.OPTION].unique().tolist()) == {0, 1}, "nothing is known: either one"
    agent.learn(rolled)
    observation = env.reset()[keys.OBSERVATION]
    for learner in agent.learners:
        learner.policy.is_trained.fill_(True)
    with set_exploration_type(GREEDY):
        value = agent.selector.option_values(States(observation))
    assert value.shape == (16, 2) and value.isfinite().all()
    assert len(value.argmax(-1).unique()) == 2 or not is_shared, "another boat for another layout"


@pytest.mark.parametrize("make", [PDQN, HyAR, partial(PADDPG, twin=True), TD3BC])
def test_values_are_free_of_the_noise_that_smooths_targets(make):
    learner = make(BOATS, target_smoothing=0.5, target_smoothing_clip=1.0)
    states = torch.randn(50, BOATS.observation_dim)
    with global_generators_unmoved():
        value = learner.value(States(states))
    assert torch.equal(learner.value(States(states)), value)
    assert not torch.equal(learner.value(States(states), is_target=True), value)


@pytest.mark.parametrize("end_values", [False, True])
def test_while_exploring_options_without_an_update_come_first(end_values):
    learners = [PETS(BOATS.of_option(i), device=CPU, **{**OPTIONS, "end_values": end_values}) for i in range(2)]
    agent = HierarchicalAgent(Value(BOATS, epsilon=0.0), learners, BOATS)
    learners[0].updates += 1
    learners[0].policy.is_trained.fill_(True)
    observation = with_decisions(BoatDockEnv(4, controller="choose")).reset()[keys.OBSERVATION]
    value = agent.selector.option_values(States(observation))
    assert value[:, 0].isfinite().all() and value[:, 1].isinf().all()
    with set_exploration_type(GREEDY):
        assert agent.selector.option_values(States(observation)).isfinite().all()


def test_one_model_of_both_boats_sees_directions_alone():
    (learner,) = make_agent(is_shared=True).learners
    model = learner.model
    contexts = model.frame.geometry.entries_of_contexts
    assert len(contexts) == 3, "which boat it is, and the option"
    state = torch.rand(3, 20, model.state_mean.numel())
    action = model.action_inputs(torch.zeros(3, 20, dtype=torch.long), torch.rand(3, 20, 1))
    changed = state.clone()
    changed[..., contexts] = torch.rand(3, 20, 3)
    with torch.no_grad():
        for part, other in zip(model.in_frame(state, action), model.in_frame(changed, action), strict=True):
            torch.testing.assert_close(part[..., :1], other[..., :1])
