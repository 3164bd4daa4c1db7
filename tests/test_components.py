"""Actions of several components: what each learner makes of them, and what it cannot represent."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_components import OneStep, random_steps

from hpamdp import keys
from hpamdp.components import Components
from hpamdp.env.decisions import with_decisions
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
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

PAIR = Components((2, 3))
FAST = {"lr": 3e-3, "lr_final": 1e-3, "anneal_steps": 20_000, "minibatch_size": 128, "epochs": 4}
FAST |= {"hidden_dims": (32,), "critic_hidden_dims": (32,)}
SMALL = {"hidden_dims": (64, 64), "warmup_steps": 300}


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
    assert PAIR.is_chosen(best).tolist() == [
        [False, True, False, False, True],
        [True, False, True, False, False],
    ]
    log_probs = PAIR.log_softmax(values)
    torch.testing.assert_close(log_probs[:, :2].exp().sum(-1), torch.ones(2))
    torch.testing.assert_close(log_probs[:, 2:].exp().sum(-1), torch.ones(2))


def test_the_learners_of_policies_reach_the_best_pair_of_a_step():
    for settings in ({}, {"autoregressive": True}):
        torch.manual_seed(0)
        learner = HPPO(PAMDPSpecs.from_env(OneStep()), **FAST, **settings)
        train(learner, OneStep(256), 40)
        assert greedy_reward(learner) > 0.97, settings


@pytest.mark.parametrize("learner_class", [PDQN, HSAC, PADDPG])
def test_the_learners_of_values_reach_the_best_pair_of_a_step(learner_class):
    torch.manual_seed(0)
    settings = {} if learner_class is HSAC else {"epsilon_steps": 2000}
    settings |= {"actor_lr": 1e-3} if learner_class is PADDPG else {}
    learner = learner_class(PAMDPSpecs.from_env(OneStep()), **SMALL, **settings, batch_size=64)
    train(learner, OneStep(32), 120 if learner_class is PADDPG else 80)
    assert greedy_reward(learner) > 0.95


@pytest.mark.parametrize("learner_class", [DLPA, PETS])
def test_planners_reach_the_best_pair_of_a_step(learner_class):
    torch.manual_seed(0)
    settings = {"warmup_steps": 300, "updates_per_step": 1.0, "horizon": 1}
    settings |= {"num_samples": 128} if learner_class is DLPA else {}
    learner = learner_class(PAMDPSpecs.from_env(OneStep()), **settings)
    train(learner, OneStep(20), 30)
    assert greedy_reward(learner) > 0.9


@pytest.mark.parametrize("learner_class", [BC, IQL])
@pytest.mark.parametrize("autoregressive", [False, True])
def test_learners_from_data_reach_the_best_pair_of_a_step(learner_class, autoregressive):
    torch.manual_seed(0)
    env = OneStep()
    learner = learner_class(PAMDPSpecs.from_env(env), autoregressive=autoregressive, hidden_dims=(32,), batch_size=128)
    data = random_steps(env, 3000)
    if learner_class is BC:
        data = data[data["next", "reward"].flatten() > 0.9]
    learner.add_demonstrations(data, torch.ones(data.shape, dtype=torch.bool))
    learner.update(400)
    assert greedy_reward(learner) > 0.9


def test_imitation_of_matching_pairs_needs_autoregressive_heads():
    """Half of the data are pairs (0, 0), half (1, 1); independent heads mix them."""
    env = OneStep(pays="matched")
    sampled = {}
    for autoregressive in (False, True):
        torch.manual_seed(0)
        learner = BC(PAMDPSpecs.from_env(env), autoregressive=autoregressive, hidden_dims=(32,))
        data = random_steps(env, 4000)
        data = data[data["next", "reward"].flatten() > 0.9]
        learner.add_demonstrations(data, torch.ones(data.shape, dtype=torch.bool))
        learner.update(300)
        steps = with_decisions(OneStep(1000, pays="matched")).rollout(1, learner.policy)
        sampled[autoregressive] = (steps["next", "reward"] > 0.0).float().mean().item()
    assert sampled[False] < 0.6
    assert sampled[True] > 0.97


@pytest.mark.parametrize(
    ("learner_class", "settings", "reaches"),
    [
        (HPPO, {}, False),
        (HPPO, {"credit": "summed"}, False),
        (HPPO, {"credit": "mixed"}, False),
        (HPPO, {"autoregressive": True}, True),
    ],
)
def test_a_pair_off_the_marginals_is_reached_by_autoregressive_policies_alone(learner_class, settings, reaches):
    torch.manual_seed(0)
    learner = learner_class(
        PAMDPSpecs.from_env(OneStep()), **FAST, **settings, discrete_entropy=0.1, entropy_final=0.01
    )
    train(learner, OneStep(256, pays="climbing"), 80)
    reward = greedy_reward(learner, pays="climbing")
    assert (reward > 0.95) if reaches else (0.4 < reward < 0.55)


def test_autoregressive_heads_and_random_agents_never_choose_a_pair_that_is_forbidden():
    torch.manual_seed(0)
    env = OneStep(200, forbids_pairs=True)
    specs = PAMDPSpecs.from_env(env)
    for learner in (Random(specs), HPPO(specs, autoregressive=True, **FAST)):
        train(learner, env, 5)
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
