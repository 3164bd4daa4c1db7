"""Actions of several components: what each learner makes of them, and what it cannot represent."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import combinations, product

import pytest
import torch
from torchrl.data import Binary
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_components import OneStep, random_steps

from hpamdp import keys
from hpamdp.api.export import GreedyStep
from hpamdp.components import Components
from hpamdp.data import DataError
from hpamdp.data.row_checks import check_actions
from hpamdp.env.base import ProblemError
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.bc import BC
from hpamdp.policies.low_level.dlpa.learner import DLPA
from hpamdp.policies.low_level.hppo import HPPO
from hpamdp.policies.low_level.hsac import HSAC
from hpamdp.policies.low_level.hyar import HyAR
from hpamdp.policies.low_level.iql import IQL
from hpamdp.policies.low_level.paddpg import PADDPG
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.policies.low_level.pets.learner import PETS
from hpamdp.policies.low_level.qpamdp import QPAMDP
from hpamdp.policies.low_level.random import Random
from hpamdp.policies.low_level.td3_bc import TD3BC
from hpamdp.policies.masks import random_discrete
from hpamdp.policies.shared.autoregressive_actor import AutoregressiveActor
from hpamdp.policies.shared.hybrid_distribution import HybridDistribution
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

PAIR = Components((2, 3))
FAST = {"lr": 3e-3, "lr_final": 1e-3, "anneal_steps": 20_000, "minibatch_size": 128, "epochs": 4}
FAST |= {"hidden_dims": (32,), "critic_hidden_dims": (32,)}
SMALL = {"hidden_dims": (64, 64), "warmup_steps": 300}


class HalfForbidden(OneStep):
    """Whole parameters of the first component, whose discrete action that equals the coin is forbidden."""

    integer_parameters = (True, True)

    def __init__(self, num_envs=1, **settings):
        super().__init__(num_envs, **settings)
        mask = Binary(5, shape=(num_envs, 5), dtype=torch.bool)
        self.observation_spec = self.observation_spec.clone().update({keys.ACTION_MASK: mask})

    def make_action_spec(self, low, high, **settings):
        return super().make_action_spec(3.0 * low, 3.0 * high, **settings)

    def _read(self, *, is_over):
        td = super()._read(is_over=is_over)
        mask = torch.ones(*self.batch_size, 5, dtype=torch.bool)
        mask[:, :2] = torch.arange(2) != self.coin.unsqueeze(-1)
        return td.set(keys.ACTION_MASK, mask)


def train(learner, env, num_batches):
    tracked = with_decisions(env)
    for _ in range(num_batches):
        with set_exploration_type(ExplorationType.RANDOM):
            batch = tracked.rollout(1, learner.policy, break_when_any_done=False)
        learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))


def greedy_reward(learner, **settings):
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        steps = with_decisions(OneStep(128, seed=9, **settings)).rollout(1, learner.policy)
    return steps["next", "reward"].mean().item()


def test_of_several_components_each_is_chosen_by_its_own_values():
    values = torch.tensor([[0.0, 1.0, 5.0, 4.0, 6.0], [2.0, 1.0, 7.0, 4.0, 6.0]])
    best = PAIR.best(values)
    assert best.tolist() == [[1, 2], [0, 0]]
    assert PAIR.of_choice(values, best).tolist() == [[1.0, 6.0], [2.0, 7.0]]
    assert PAIR.is_chosen(best).tolist() == [[False, True, False, False, True], [True, False, True, False, False]]
    log_probs = PAIR.log_softmax(values)
    torch.testing.assert_close(log_probs[:, :2].exp().sum(-1), torch.ones(2))
    torch.testing.assert_close(log_probs[:, 2:].exp().sum(-1), torch.ones(2))


@pytest.mark.parametrize(
    "learner_class", [PDQN, *(pytest.param(each, marks=pytest.mark.slow) for each in (HSAC, PADDPG))]
)
def test_the_learners_of_values_reach_the_best_pair_of_a_step(learner_class):
    torch.manual_seed(0)
    settings = {} if learner_class is HSAC else {"epsilon_steps": 2000}
    settings |= {"actor_lr": 1e-3} if learner_class is PADDPG else {}
    learner = learner_class(PAMDPSpecs.from_env(OneStep()), **SMALL, **settings, batch_size=64)
    train(learner, OneStep(32), 60)
    assert greedy_reward(learner) > 0.95


@pytest.mark.parametrize("learner_class", [DLPA, PETS])
def test_planners_reach_the_best_pair_of_a_step(learner_class):
    torch.manual_seed(0)
    settings = {"updates_per_step": 1.0, "horizon": 1}
    settings |= {"warmup_steps": 120, "num_samples": 128} if learner_class is DLPA else {"warmup_steps": 160}
    learner = learner_class(PAMDPSpecs.from_env(OneStep()), **settings)
    train(learner, OneStep(20), 10 if learner_class is DLPA else 14)
    assert greedy_reward(learner) > 0.9


@pytest.mark.parametrize("learner_class", [BC, IQL])
def test_learners_from_data_reach_the_best_pair_of_a_step(learner_class):
    torch.manual_seed(0)
    env = OneStep()
    learner = learner_class(PAMDPSpecs.from_env(env), hidden_dims=(32,), batch_size=128)
    data = random_steps(env, 3000)
    if learner_class is BC:
        data = data[data["next", "reward"].flatten() > 0.9]
    learner.add_demonstrations(data, torch.ones(data.shape, dtype=torch.bool))
    learner.update(100 if learner_class is BC else 400)
    assert greedy_reward(learner) > 0.9


@pytest.mark.parametrize("autoregressive", [False, True])
def test_a_pair_off_the_marginals_is_reached_by_autoregressive_policies_alone(autoregressive):
    torch.manual_seed(0)
    settings = FAST | {"lr": 6e-3, "anneal_steps": 10_000, "minibatch_size": 256, "autoregressive": autoregressive}
    learner = HPPO(PAMDPSpecs.from_env(OneStep()), **settings, discrete_entropy=0.1, entropy_final=0.01)
    train(learner, OneStep(256, pays="climbing"), 40)
    reward = greedy_reward(learner, pays="climbing")
    assert reward > 0.95 if autoregressive else 0.4 < reward < 0.55


@pytest.mark.parametrize("autoregressive", [False, True])
def test_the_best_pair_of_random_data_is_reached_by_autoregressive_policies_alone(autoregressive):
    """The weights are clipped, so all good pairs have similar probabilities; the best pair has the highest."""
    torch.manual_seed(0)
    env = OneStep(pays="climbing")
    settings = {"hidden_dims": (32,), "batch_size": 128, "tau": 0.02}
    learner = IQL(PAMDPSpecs.from_env(env), autoregressive=autoregressive, **settings)
    data = random_steps(env, 3000)
    learner.add_demonstrations(data, torch.ones(data.shape, dtype=torch.bool))
    learner.update(400)
    reward = greedy_reward(learner, pays="climbing")
    assert reward > 0.9 if autoregressive else reward < 0.55


@pytest.mark.slow
@pytest.mark.parametrize("autoregressive", [False, True])
def test_soft_values_of_pairs_off_the_marginals_are_reached_by_autoregressive_policies_alone(autoregressive):
    torch.manual_seed(0)
    specs = PAMDPSpecs.from_env(OneStep())
    learner = HSAC(specs, **SMALL, batch_size=64, autoregressive=autoregressive)
    train(learner, OneStep(32, pays="climbing"), 60)
    reward = greedy_reward(learner, pays="climbing")
    assert reward > 0.95 if autoregressive else 0.4 < reward < 0.55


def test_the_greedy_action_of_autoregressive_heads_is_the_most_probable_together():
    torch.manual_seed(0)
    specs = PAMDPSpecs(2, (), (1, 0, 0, 0, 2, 0, 0), (-1.0,) * 3, (1.0,) * 3, component_sizes=(2, 3, 2))
    actor = AutoregressiveActor(specs, (8,), (0.1, 1.0))
    with torch.no_grad():
        for head in actor.heads:
            head[-1].weight.normal_(0.0, 2.0)
    state, mask = torch.randn(200, 2), torch.rand(200, 7) < 0.8
    mask[:, [0, 2, 5]] = True
    choices = torch.tensor(list(product(range(2), range(3), range(2))))

    def log_prob(choice):
        parts = iter(choice)
        forced = actor.act(lambda part: (next(parts).expand(200), part.mode()[1]), state, mask, None)
        return forced[2].log_prob(*forced[:2])[0].sum(-1)

    log_probs = torch.stack([log_prob(choice) for choice in choices], -1)
    discrete, raw = actor.most_probable(state, mask, None)
    assert discrete.equal(choices[log_probs.argmax(-1)])
    one_by_one, _, _ = actor.act(HybridDistribution.mode, state, mask, None)
    assert 0 < (one_by_one != discrete).any(-1).sum() < 100
    parts = iter(zip(discrete.unbind(-1), raw.split(actor.parameter_sizes, -1), strict=True))
    _, _, distribution = actor.act(lambda _: next(parts), state, mask, None)
    torch.testing.assert_close(raw, distribution.mean)


def test_every_sequence_of_choices_that_a_mask_of_pairs_offers_can_be_completed():
    """Three choices that go together by twos may leave nothing to the fourth component."""
    torch.manual_seed(0)
    components = Components((2, 3, 2, 2))
    specs = PAMDPSpecs(1, (), (0,) * 9, (), (), component_sizes=components.sizes, has_pair_mask=True)
    mask, pair_mask = torch.rand(2000, 9) < 0.9, torch.rand(2000, 9, 9) < 0.6
    places = components.places(torch.tensor(list(product(*map(range, components.sizes)))))
    is_allowed = mask[:, places].all(-1)
    for earlier, later in combinations(places.unbind(-1), 2):
        is_allowed &= pair_mask[:, earlier, later]
    has_any = is_allowed.any(-1)
    assert 500 < has_any.sum() < 1500
    assert components.leaves_any(mask, pair_mask).equal(has_any)
    mask, pair_mask, is_allowed = mask[has_any], pair_mask[has_any], is_allowed[has_any]
    actor = AutoregressiveActor(specs, (8,), (0.1, 1.0))
    state = torch.randn(len(mask), 1)
    for discrete in (
        random_discrete(specs, mask.shape[:1], mask, mask.device, pair_mask),
        actor.act(HybridDistribution.sample, state, mask, pair_mask)[0],
        actor.most_probable(state, mask, pair_mask)[0],
    ):
        number = (discrete * torch.tensor([12, 4, 2, 1])).sum(-1, keepdim=True)
        assert is_allowed.gather(-1, number).all()


def test_an_option_without_a_pair_that_goes_together_is_not_possible():
    env = OneStep(4, forbids_pairs=True)
    env.group_actions({"matches": [0, 1, 2, 3], "never matches": [0, 3, 4]})
    assert with_decisions(env).reset()[keys.OPTION_MASK].tolist() == [[True, False]] * 4


def test_autoregressive_heads_and_random_agents_never_choose_a_pair_that_is_forbidden():
    torch.manual_seed(0)
    env = OneStep(200, forbids_pairs=True)
    specs = PAMDPSpecs.from_env(env)
    for learner in (Random(specs), HPPO(specs, autoregressive=True, **FAST)):
        train(learner, env, 5)
        assert env.violations == 0


def test_data_without_the_masks_or_bounds_of_its_states_or_against_them_are_refused_in_one_line():
    rows = random_steps(OneStep(), 20).flatten()
    pairs = PAMDPSpecs.from_env(OneStep(forbids_pairs=True))
    with pytest.raises(DataError, match="lack pair_mask, which the environment gives"):
        check_actions(rows, pairs)
    mask = torch.ones(20, 5, 5, dtype=torch.bool)
    check_actions(rows.set(keys.PAIR_MASK, mask), pairs)
    first, second = rows[keys.DISCRETE][7].tolist()
    mask[7, first, 2 + second] = False
    with pytest.raises(DataError, match=r"row 7: action.discrete\[1\] is \d, but .* the row's pair_mask"):
        check_actions(rows.set(keys.PAIR_MASK, mask), pairs)
    bounded = replace(PAMDPSpecs.from_env(OneStep()), has_parameter_bounds=True)
    with pytest.raises(DataError, match="lack parameter_low"):
        check_actions(rows, bounded)
    high = torch.ones(20, 2)
    rows.set(keys.PARAMETER_LOW, -high).set(keys.PARAMETER_HIGH, high.clone())
    check_actions(rows, bounded)
    rows[keys.PARAMETER_HIGH][3] = rows[keys.PARAMETERS][3] - 0.1
    with pytest.raises(DataError, match=r"row 3: action.parameters\[\d\] is .*within the row's parameter_low"):
        check_actions(rows, bounded)


@pytest.mark.parametrize("is_shared", [False, True])
def test_learners_of_options_never_choose_a_pair_that_is_forbidden(is_shared):
    torch.manual_seed(0)
    env = OneStep(200, forbids_pairs=True)
    env.group_actions({"all": [0, 1, 2, 3, 4], "some": [0, 1, 2, 3]})
    specs = PAMDPSpecs.from_env(env)
    seen = [specs.with_option_observed()] if is_shared else [specs.of_option(option) for option in range(2)]
    learners = [HPPO(each, autoregressive=True, **FAST) for each in seen]
    agent = HierarchicalAgent(Uniform(specs), learners, specs, is_shared)
    for _ in range(3):
        agent.learn(with_decisions(env).rollout(1, agent.policy, break_when_any_done=False))
    assert env.violations == 0


def test_an_option_is_possible_where_it_has_an_allowed_action_of_each_component():
    env = HalfForbidden(64)
    env.group_actions({"all": [0, 1, 2, 3, 4], "first": [0, 2, 3], "second": [1, 2, 3]})
    specs = PAMDPSpecs.from_env(env)
    agent = HierarchicalAgent(Uniform(specs), [Random(specs.with_option_observed())], specs, is_shared=True)
    batch = with_decisions(env).rollout(1, agent.policy).squeeze(1)
    coin = batch[keys.OBSERVATION].argmax(-1)
    expected = torch.stack([torch.ones_like(coin), coin == 1, coin == 0], -1).bool()
    assert batch[keys.OPTION_MASK].equal(expected)
    assert specs.components.of_choice(batch[keys.ACTION_MASK], batch[keys.DISCRETE]).all()
    step = GreedyStep(agent, env.gymnasium_form(), None)
    step.greedy_choice = lambda td: td[keys.OPTION_MASK].long().argmin(-1)  # the option that is not possible
    held, is_due = torch.zeros(64, dtype=torch.long), torch.ones(64, dtype=torch.bool)
    given = {**batch.select(keys.OBSERVATION, keys.ACTION_MASK), "held_option": held, keys.IS_DECISION: is_due}
    assert step(*(given[name] for name in step.names))[2].equal(1 + coin)


@pytest.mark.parametrize(
    "learner",
    [
        lambda specs: HPPO(specs, **FAST, autoregressive=True),
        lambda specs: HSAC(specs, warmup_steps=100, updates_per_step=0.02),
    ],
)
def test_updates_in_bfloat16_have_nearly_the_same_likelihoods(learner):
    torch.manual_seed(0)
    env = HalfForbidden(256)
    learner = learner(PAMDPSpecs.from_env(env))
    learner.lower_precision()
    train(learner, env, 1)
    state, raw = torch.eye(2), torch.tensor([[0.3, -0.2], [0.9, 0.4]])
    discrete = torch.tensor([[0, 2], [1, 1]])
    exact = learner.actor.given(state, discrete, raw, None, None)
    with torch.autocast("cpu", torch.bfloat16):
        lower = learner.actor.given(state, discrete, raw, None, None)
        parts = [*lower.log_prob(discrete, raw), *lower.entropy()]
    assert all(part.dtype == torch.float32 for part in parts)
    for part, expected in zip(parts, [*exact.log_prob(discrete, raw), *exact.entropy()], strict=True):
        torch.testing.assert_close(part, expected, atol=0.03, rtol=0.03)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
@pytest.mark.parametrize(
    ("learner", "forbids_pairs"),
    [
        (lambda specs: HPPO(specs, **FAST, autoregressive=True), True),
        (lambda specs: IQL(specs, warmup_steps=64, updates_per_step=0.05, autoregressive=True), True),
        (lambda specs: HSAC(specs, warmup_steps=64, updates_per_step=0.05, autoregressive=True), False),
        (lambda specs: PDQN(specs, warmup_steps=64, updates_per_step=0.05), False),
    ],
    ids=["hppo", "iql", "hsac", "pdqn"],
)
def test_updates_of_several_components_can_be_compiled(learner, forbids_pairs):
    torch.manual_seed(0)
    env = OneStep(64, forbids_pairs=forbids_pairs)
    learner = learner(PAMDPSpecs.from_env(env))
    before = [parameter.clone() for parameter in learner.actor.parameters()]
    learner.compile_updates()
    train(learner, env, 3)
    assert any(not one.equal(other) for one, other in zip(before, learner.actor.parameters(), strict=True))
    assert env.violations == 0


def test_independent_heads_refuse_a_mask_of_pairs():
    specs = PAMDPSpecs.from_env(OneStep(forbids_pairs=True))
    with pytest.raises(SettingError, match="autoregressive=true"):
        HPPO(specs)
    with pytest.raises(SettingError, match="pair_mask"):
        PDQN(specs)


@pytest.mark.parametrize("learner_class", [HyAR, QPAMDP, TD3BC])
def test_learners_of_one_choice_refuse_several_components_in_one_line(learner_class):
    with pytest.raises(SettingError, match=r"cannot learn an action of several components"):
        learner_class(PAMDPSpecs.from_env(OneStep()))


def test_the_likelihood_of_an_autoregressive_action_is_that_with_which_it_was_drawn():
    torch.manual_seed(0)
    env = OneStep(64)
    learner = HPPO(PAMDPSpecs.from_env(env), autoregressive=True, minibatch_size=1000)
    with set_exploration_type(ExplorationType.RANDOM):
        batch = with_decisions(env).rollout(1, learner.policy)
    features = batch[keys.OBSERVATION].flatten(0, 1)
    discrete, raw = batch[keys.DISCRETE].flatten(0, 1), batch["raw_parameters"].flatten(0, 1)
    given = learner.actor.given(features, discrete, raw, None, None)
    drawn = iter([(discrete[:, 0], raw), (discrete[:, 1], raw[:, :0])])
    _, _, same = learner.actor.act(lambda _: next(drawn), features, None, None)
    for one, other in zip(given.log_prob(discrete, raw), same.log_prob(discrete, raw), strict=True):
        torch.testing.assert_close(one, other)


def test_a_mask_of_pairs_that_allows_nothing_ends_with_one_line():
    class Stuck(OneStep):
        def _read(self, *, is_over):
            td = super()._read(is_over=is_over)
            return td.set(keys.PAIR_MASK, torch.zeros_like(td[keys.PAIR_MASK]))

    with pytest.raises(ProblemError, match="environment 0 gave a pair_mask that allows no action"):
        with_decisions(Stuck(2, forbids_pairs=True)).reset()


@pytest.mark.parametrize("is_truncated", [False, True], ids=["terminated", "truncated"])
@pytest.mark.parametrize("forbidden", [[1], [0, 1]], ids=["one", "both"])
def test_after_the_end_actions_belong_to_the_chosen_option_even_if_its_pairs_are_forbidden(forbidden, is_truncated):
    class Closing(OneStep):
        def _read(self, *, is_over):
            td = super()._read(is_over=is_over)
            if is_over:
                td[keys.PAIR_MASK][:, forbidden, [2 + i for i in forbidden]] = False
            if is_truncated:
                td[keys.TERMINATED], td[keys.TRUNCATED] = td[keys.TRUNCATED], td[keys.TERMINATED]
            return td

    env = Closing(16, forbids_pairs=True)
    env.group_actions({"zeros": [0, 2], "ones": [1, 3]})
    env = with_decisions(env)
    specs = PAMDPSpecs.from_env(env)
    torch.manual_seed(0)
    agent = HierarchicalAgent(Uniform(specs), [Random(specs.of_option(i)) for i in range(2)], specs)
    after = env.step_mdp(env.step(agent.policy(env.reset())))
    played = agent.policy(after)
    option, discrete = played[keys.OPTION], played[keys.DISCRETE]
    assert discrete[:, 0].equal(option) and discrete[:, 1].equal(option)


def test_components_see_whole_numbers_in_the_middle_of_their_cells_when_acting_and_when_learning():
    torch.manual_seed(0)
    specs = PAMDPSpecs(1, (), (1, 0, 0), (0.0,), (99.0,), component_sizes=(1, 2), integer_parameters=(True,))
    actor = AutoregressiveActor(specs, (8,), (0.1, 1.0))
    state = torch.randn(6, 1)
    discrete, raw, acted = actor.act(HybridDistribution.sample, state, None, None)
    learned = actor.given(state, discrete, specs.to_unit(specs.from_unit(raw.clamp(-1.0, 1.0))), None, None)
    torch.testing.assert_close(acted.discrete_log_probs, learned.discrete_log_probs)
