"""Exploration beside the learners: held actions and rewards for new states, each with what is its own."""

import signal
from dataclasses import replace
from itertools import product

import pytest
import torch
from conftest import compose_config, make_config
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from test_grid import SHORT
from test_masks import make_learner, play_and_learn
from test_resume import SMALL, stop_and_resume
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_components import OneStep
from toy_corridor import Corridor, greedy_return, trained
from toy_masks import NUM_DISCRETE, Forbidden
from toy_steps import SPECS, one_step_rows, states

import hpamdp
from hpamdp import keys
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Bonus
from hpamdp.policies.exploration.counts import Counts, VisitTable
from hpamdp.policies.exploration.held import Held, HeldPolicy, zeta_distribution
from hpamdp.policies.exploration.novelty import Novelty
from hpamdp.policies.exploration.options import CountsOptions, HeldOptions
from hpamdp.policies.low_level.dlpa.learner import DLPA
from hpamdp.policies.low_level.hppo import HPPO, OWN
from hpamdp.policies.low_level.hyar import LATENT, HyAR
from hpamdp.policies.low_level.paddpg import PADDPG, SCORES
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.policies.low_level.pets.learner import PETS
from hpamdp.policies.low_level.qpamdp import PARAMETERS, QPAMDP
from hpamdp.run.assemble import assemble
from hpamdp.run.train import run
from hpamdp.specs import PAMDPSpecs

EXPLORING = ["hppo", "pdqn", "paddpg", "hsac", "hyar", "qpamdp", "dlpa", "pets"]


def pairs(*quick: tuple[str, str]) -> list:
    """Return all pairs of a learner and an exploration; tests of those that are not named are slow."""
    others = [pair for pair in product(EXPLORING, ("held", "novelty", "counts")) if pair not in quick]
    return [*quick, *(pytest.param(*pair, marks=pytest.mark.slow) for pair in others)]


PLATFORM = ["env=platform", "high=none"]


class FirstAction(TensorDictModuleBase):
    """Always takes discrete action 0 with its parameters at their lower bounds."""

    in_keys = (keys.OBSERVATION,)
    out_keys = (keys.DISCRETE, keys.PARAMETERS)

    def forward(self, td):
        unit = -torch.ones(*td.batch_size, SPECS.num_parameters)
        discrete = torch.zeros(td.batch_size, dtype=torch.long)
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": SPECS.from_unit(unit)}})


def held_policy(specs=SPECS, **settings) -> HeldPolicy:
    return HeldPolicy(FirstAction(), specs, HeldOptions(**settings))


def step_of(td: TensorDict, *begins: int) -> TensorDict:
    """Return the next step: what the policy carries, and where episodes begin."""
    carried = td.select(keys.HOLD_STEPS, keys.HOLD_DISCRETE, keys.HOLD_UNIT)
    is_decision = torch.zeros(len(td), 1, dtype=torch.bool)
    is_decision[list(begins)] = True
    return states(len(td)).update(carried).set(keys.IS_DECISION, is_decision)


# Held actions.


@pytest.mark.parametrize("mu", [1.5, 2.0])
def test_the_lengths_of_held_actions_have_the_zeta_distribution(mu):
    torch.manual_seed(0)
    expected = zeta_distribution(mu, 50)
    assert torch.allclose(expected[1] / expected[0], torch.tensor(2.0**-mu, dtype=torch.float64))
    lengths = held_policy(mu=mu, longest=50).lengths(torch.Size([100_000]))
    assert lengths.min() == 1 and lengths.max() == 50
    counted = torch.bincount(lengths, minlength=51)[1:] / len(lengths)
    assert (counted - expected).abs().max() < 0.005
    # As the policy draws them: a run of held steps has the length that was drawn.
    policy = held_policy(epsilon=1.0, mu=mu, longest=50)
    begun = policy(states(20_000))[keys.HOLD_STEPS] + 1
    assert (torch.bincount(begun, minlength=51)[1:] / len(begun) - expected).abs().max() < 0.015


def test_a_held_action_keeps_its_parameters_until_its_steps_are_over():
    torch.manual_seed(0)
    policy = held_policy(epsilon=1.0, mu=1.1, longest=9)
    td = policy(states(500))
    seen = []
    for _ in range(12):
        before, td = td, policy(step_of(td))
        goes_on = before[keys.HOLD_STEPS] > 0
        seen.append(goes_on)
        for key in (keys.DISCRETE, keys.PARAMETERS):
            assert torch.equal(td[key][goes_on], before[key][goes_on])
        assert torch.equal(td[keys.HOLD_STEPS][goes_on], before[keys.HOLD_STEPS][goes_on] - 1)
        fresh = td[keys.PARAMETERS][~goes_on]
        assert (fresh != before[keys.PARAMETERS][~goes_on]).any(-1).all(), "another choice begins at once"
        low, high = SPECS.bounds(fresh)
        assert (fresh >= low).all() and (fresh <= high).all()
        assert td[keys.IS_HELD].all()
    assert torch.stack(seen).any(0).all()


def test_a_held_action_ends_with_its_episode():
    torch.manual_seed(0)
    policy = held_policy(epsilon=1.0, mu=1.01, longest=100_000)
    td = policy(states(200))
    td[keys.HOLD_STEPS][:] = 50
    after = policy(step_of(td, *range(100)))
    same = (after[keys.PARAMETERS] == td[keys.PARAMETERS]).all(-1)
    assert not same[:100].any() and same[100:].all()


def test_an_action_of_a_shared_learner_is_held_until_the_episode_ends_and_of_an_options_learner_until_the_option_ends():
    specs = replace(SPECS, option_names=("a", "b"))
    assert held_policy(specs).begins_key == keys.EPISODE_STEPS
    assert held_policy(specs.of_option(1)).begins_key == held_policy(SPECS).begins_key == keys.IS_DECISION


def test_greedy_acting_never_holds():
    policy = held_policy(epsilon=1.0)
    held = policy(states(50))
    held[keys.HOLD_STEPS][:] = 50
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        td = policy(step_of(held))
    assert (td[keys.DISCRETE] == 0).all() and not td[keys.IS_HELD].any() and (td[keys.HOLD_STEPS] == 0).all()
    assert torch.equal(td[keys.PARAMETERS], FirstAction()(states(50))[keys.PARAMETERS])


def test_the_share_of_steps_that_begin_a_hold_is_epsilon_and_falls():
    torch.manual_seed(0)
    learner = PDQN(SPECS, warmup_steps=10_000)
    exploration = Held(learner, epsilon=0.4, epsilon_final=0.1, epsilon_steps=1000, longest=1)
    share = []
    for _ in range(3):
        td = exploration.policy(states(20_000))
        share.append(td[keys.IS_HELD].float().mean().item())
        rows = td[:500].unsqueeze(-1)
        explored = exploration.learn(rows, torch.ones(500, 1, dtype=torch.bool))
    assert share == pytest.approx([0.4, 0.25, 0.1], abs=0.015)
    assert explored.scalars["held"] == rows[keys.IS_HELD].float().mean().item() and explored.bonus is None


@pytest.mark.parametrize("name", ["hppo", "hyar"])
def test_held_actions_are_allowed_ones(name):
    env = with_decisions(Forbidden(8), 1.0)
    learner = make_learner(name, PAMDPSpecs.from_env(env))
    agent = HierarchicalAgent(None, [learner], learner.specs, explorations=[Held(learner, epsilon=0.9, mu=1.01)])
    play_and_learn(env, agent, 6)
    assert env.base_env.violations == 0
    rolled = env.rollout(20, agent.policy, break_when_any_done=False)
    goes_on = (rolled[keys.HOLD_STEPS][:, :-1] > 0) & ~rolled["next", "done"][:, :-1].squeeze(-1)
    held = rolled[keys.HOLD_DISCRETE][:, :-1]
    is_allowed = rolled[keys.ACTION_MASK][:, 1:].gather(-1, held.unsqueeze(-1)).squeeze(-1)
    changed = rolled[keys.DISCRETE][:, 1:] != held
    assert (goes_on & ~is_allowed).any() and torch.equal(changed & goes_on, changed & goes_on & ~is_allowed)
    assert NUM_DISCRETE == 3


def test_held_actions_of_several_components_go_together():
    torch.manual_seed(0)
    env = with_decisions(OneStep(64, forbids_pairs=True), 1.0)
    specs = PAMDPSpecs.from_env(env)
    learner = HPPO(specs, minibatch_size=64, autoregressive=True)
    agent = HierarchicalAgent(None, [learner], specs, explorations=[Held(learner, epsilon=1.0)])
    batch = env.rollout(8, agent.policy, break_when_any_done=False)
    assert batch[keys.IS_HELD].all() and env.base_env.violations == 0
    assert "discrete_kl" in "".join(agent.learn(batch))
    # A hold goes on only if its pair is allowed in the next state, too.
    held = torch.tensor([[0, 0], [0, 1]])
    pairs = batch[0, 0][keys.PAIR_MASK].expand(2, 5, 5)
    assert agent.explorations[0].policy._is_allowed(held, None, pairs).tolist() == [True, False]


def test_hppo_learns_no_policy_from_held_steps_but_their_values():
    torch.manual_seed(0)
    learner = HPPO(SPECS, minibatch_size=64)
    exploration = Held(learner, epsilon=0.5)
    agent = HierarchicalAgent(None, [learner], SPECS, explorations=[exploration])
    td = exploration.policy(states(256))
    td["next"] = states(256).update(
        {
            keys.REWARD: torch.randn(256, 1),
            **dict.fromkeys((keys.DONE, keys.TERMINATED), torch.ones(256, 1, dtype=torch.bool)),
        }
    )
    batch = td.unsqueeze(-1)
    rows = learner.rows(batch, torch.ones(256, 1, dtype=torch.bool))
    assert torch.equal(rows[OWN] == 0.0, td[keys.IS_HELD]) and 64 < rows[OWN].sum() < 192

    def gradients(rows):
        learner.optimizer.zero_grad()
        learner.loss(dict(rows.items()), torch.tensor(0.0))[0].backward()
        return [
            torch.cat([weight.grad.flatten() for weight in net.parameters()]) for net in (learner.actor, learner.critic)
        ]

    actor, critic = gradients(rows)
    own = rows[rows[OWN] > 0.0]
    assert torch.allclose(actor, gradients(own.exclude(OWN))[0], atol=1e-7)
    changed = rows.clone()
    changed["advantage"] = torch.where(rows[OWN] > 0.0, rows["advantage"], 1e6)
    assert torch.allclose(actor, gradients(changed)[0], atol=1e-7)
    changed["target"] = torch.where(rows[OWN] > 0.0, rows["target"], rows["target"] + 1.0)
    assert not torch.allclose(critic, gradients(changed)[1], atol=1e-3)
    # What the update needs is in the rows: also an action that the policy would never take.
    far = rows.clone()
    far["raw_parameters"][rows[OWN] == 0.0] = 1e3
    far["discrete_log_prob"][rows[OWN] == 0.0] = -1e9
    assert all(each.isfinite().all() for each in gradients(far))
    assert agent.learn(batch)["low/held"] == td[keys.IS_HELD].float().mean().item()


def test_what_a_policy_writes_beside_an_action_is_not_stored_for_a_held_one():
    torch.manual_seed(0)
    mask = torch.ones(256, 1, dtype=torch.bool)
    for kind in (HyAR, PADDPG):
        learner = kind(SPECS, warmup_steps=10_000)
        learner.policy.epsilon.fill_(0.0)
        exploration = Held(learner, epsilon=0.5)
        batch = one_step_rows_of(exploration.policy, 256)
        learner.learn(batch, mask)
        rows, is_held = learner.buffer[:], batch[keys.IS_HELD].squeeze(-1)
        assert 64 < is_held.sum() < 192
        if kind is HyAR:
            assert torch.equal(rows[LATENT].isnan().all(-1), is_held)
        else:
            assert torch.equal(rows[SCORES].argmax(-1), batch[keys.DISCRETE].squeeze(-1))
            same = (rows[SCORES] == batch[SCORES].squeeze(1)).all(-1)
            assert same[~is_held].all() and not same[is_held].all()


def one_step_rows_of(policy, num: int) -> TensorDict:
    """Return episodes of one step by a policy, `[num, 1]`."""

    class Acting:
        specs = SPECS

    Acting.policy = policy
    return one_step_rows(Acting, num)


def test_qpamdp_gives_held_parameters_no_gradient():
    torch.manual_seed(0)
    learner = QPAMDP(SPECS, warmup_steps=32, initial_episodes=1, relearning_episodes=1)
    exploration = Held(learner, epsilon=0.5)
    mask = torch.ones(64, 1, dtype=torch.bool)
    learner.learn(one_step_rows_of(exploration.policy, 64), mask)
    batch = one_step_rows_of(exploration.policy, 64)
    learner.phase.fill_(PARAMETERS)
    gradient = learner.rows(batch, mask)["gradient"].squeeze(1)
    is_held = batch[keys.IS_HELD].squeeze(-1)
    has_parameters = batch[keys.DISCRETE].squeeze(-1) < 2
    assert torch.equal((gradient != 0.0).any(-1), ~is_held & has_parameters) and is_held.any()


# Novelty.


def visits(num: int, place: float) -> TensorDict:
    """Return steps `[num, 1]` that lead near a place of SPECS' observations."""
    near = place + 0.05 * torch.randn(num, 4)
    after = {keys.OBSERVATION: near, keys.REWARD: torch.zeros(num, 1)}
    return TensorDict({keys.OBSERVATION: states(num)[keys.OBSERVATION], "next": after}, [num]).unsqueeze(-1)


def test_the_bonus_of_often_seen_states_falls_below_that_of_new_ones():
    torch.manual_seed(0)
    learner = HPPO(SPECS)
    novelty = Novelty(learner, weight=0.5)
    mask = torch.ones(128, 1, dtype=torch.bool)
    for _ in range(150):
        novelty.learn(visits(128, -0.5), mask)
    seen, new = (learner.bonus.of(visits(128, place)["next", keys.OBSERVATION]).mean() for place in (-0.5, 0.5))
    assert seen < 0.2 * new
    for _ in range(150):
        novelty.learn(visits(128, 0.5), mask)
    assert learner.bonus.of(visits(128, 0.5)["next", keys.OBSERVATION]).mean() < 0.3 * new


def test_bonuses_are_in_standard_deviations_whatever_the_scale_of_the_observations():
    bonuses = []
    for scale in (1.0, 1000.0):
        torch.manual_seed(0)
        learner = HPPO(SPECS)
        novelty = Novelty(learner, largest=2.0)
        batch = visits(512, 0.0)
        batch["next", keys.OBSERVATION] = scale * batch["next", keys.OBSERVATION]
        novelty.learn(batch, torch.ones(512, 1, dtype=torch.bool))
        assert (novelty.network.scale.var.sqrt() > 0.0) and novelty.network.scale.count > 500
        bonuses.append(learner.bonus.of(batch["next", keys.OBSERVATION]))
    assert torch.allclose(*bonuses, atol=1e-3)
    assert bonuses[0].max() <= 2.0 and bonuses[0].min() >= 0.0
    assert learner.bonus.of(torch.full((1, 4), 1e9)) <= 2.0


def test_the_agent_adds_the_bonus_to_the_rewards_of_an_on_policy_learner_alone(monkeypatch):
    torch.manual_seed(0)
    learner = HPPO(SPECS, minibatch_size=64)
    novelty = Novelty(learner, weight=0.5)
    agent = HierarchicalAgent(None, [learner], SPECS, explorations=[novelty])
    batch = one_step_rows(learner, 128)
    before, given = batch.clone(), []
    monkeypatch.setattr(HPPO, "learn", lambda self, batch, mask: given.append(batch) or {})
    scalars = agent.learn(batch)
    assert (batch == before).all(), "the batch itself stays as it is"
    more = given[0]["next", keys.REWARD] - before["next", keys.REWARD]
    assert (more >= 0.0).all() and more.max() > 0.0
    assert more.mean().item() == pytest.approx(0.5 * scalars["low/bonus"], rel=1e-4)


def test_a_replay_learner_stores_the_reward_and_adds_the_bonus_of_today_to_what_it_samples():
    torch.manual_seed(0)
    learner = PDQN(SPECS, warmup_steps=128, batch_size=128, reward_scale=2.0)
    novelty = Novelty(learner, weight=0.5)
    agent = HierarchicalAgent(None, [learner], SPECS, explorations=[novelty])
    batch = one_step_rows(learner, 256)
    agent.learn(batch)
    assert torch.equal(learner.buffer[:]["reward"], 2.0 * batch["next", keys.REWARD].flatten())
    sample = next(iter(learner.sample_batches(1)))
    added = []
    for _ in range(2):
        rewarded = learner.with_bonus(sample.clone(), learner.bonus)
        added.append(rewarded["reward"] - sample["reward"])
        assert torch.allclose(added[-1], learner.bonus.of(sample["next_state"]), atol=1e-6)  # 2 * 0.5
        for _ in range(100):
            agent.explorations[0].learn(batch, torch.ones(256, 1, dtype=torch.bool))
    assert added[1].mean() < 0.7 * added[0].mean()


def test_the_bonus_of_a_cell_is_one_over_the_root_of_its_visits():
    learner = HPPO(SPECS)
    counts = Counts(learner, weight=0.5, resolution=2.0)
    batch = one_step_rows(learner, 10)
    batch["next", keys.OBSERVATION] = torch.full((10, 1, 4), 0.6)
    mask = torch.ones(10, 1, dtype=torch.bool)
    mask[9] = False
    explored = counts.learn(batch, mask)
    assert explored.bonus[:9].eq(0.5 / 3.0).all() and explored.bonus[9] == 0.0, "nine visits, and another's step"
    assert explored.scalars == {"bonus": pytest.approx(1.0 / 3.0), "cells": 1.0}
    same, other = torch.full((1, 4), 0.4), torch.full((1, 4), 0.8)
    assert learner.bonus.of(same) == pytest.approx(1.0 / 3.0) and learner.bonus.of(other) == 1.0


def test_cells_leave_out_the_entries_whose_resolution_is_0():
    table = VisitTable(4, CountsOptions(resolution=[10.0, 10.0, 0.0, 0.0]))
    place, other = torch.tensor([0.3, -0.6]), torch.tensor([0.3, -0.4])
    speeds = torch.tensor([[0.0, 0.0], [-1.0, 0.7], [0.5, -0.2]])
    table.see(torch.cat([place.expand(3, 2), speeds], -1))
    assert table.bonus(torch.cat([place, -speeds[1]])) == pytest.approx(3.0**-0.5)
    assert table.bonus(torch.cat([other, speeds[1]])) == 1.0


@pytest.mark.parametrize("kind", [DLPA, PETS])
def test_exploring_plans_seek_what_is_new_and_greedy_plans_do_not(kind):
    """The models know nothing: one discrete action is said to lead to new states, or members differ about it."""
    torch.manual_seed(0)
    specs = PAMDPSpecs(2, (), (1, 1), (-1.0, -1.0), (1.0, 1.0))
    small = {"num_samples": 32, "num_elites": 4, "num_iterations": 2, "horizon": 1, "epsilon": 0.0}
    learner = kind(specs, **small, **({"linear_part": False} if kind is PETS else {}))
    policy = learner.policy
    policy.is_trained.fill_(True)
    action = 1

    class Model(torch.nn.Module):
        change_scale = torch.ones(2)
        is_predicted = torch.ones(2)

        def scaled_change(self, state, discrete, next_state):
            return next_state - state

        def forward(self, state, discrete, own, *_):
            from hpamdp.policies.shared.planning import Prediction

            leads = (discrete == action).float().unsqueeze(-1)
            if kind is DLPA:
                zero = torch.zeros(2, len(state))
                return Prediction(state + leads, zero, zero, zero - 20.0)
            members = torch.arange(len(state), dtype=torch.float32).reshape(-1, 1, 1)
            zero = torch.zeros(state.shape[:2])
            known = zero + (discrete != action).float() * 0.01  # what is known pays a little more
            return Prediction(state + leads * members, known, zero, zero - 20.0)

    model = Model()
    model.num_members, model.reward_mean = 5, torch.zeros(2)
    model.frame = getattr(learner.model, "frame", None)
    policy.model = model
    if kind is DLPA:
        policy.planner.model = model
        learner.take_bonus(Bonus(1.0, lambda state: (state.amax(-1) > 0.5).float()))
    else:
        learner.take_bonus(Bonus(1.0, None))
    td = {keys.OBSERVATION: torch.zeros(64, 2), keys.DONE: torch.zeros(64, 1, dtype=torch.bool)}
    explored = policy(TensorDict(td, [64]))[keys.DISCRETE]
    assert (explored == action).float().mean() > 0.9
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        greedy = policy(TensorDict(td, [64]))[keys.DISCRETE]
    assert (greedy == action).float().mean() < (0.1 if kind is PETS else 0.9)


@pytest.mark.parametrize("kind", [DLPA, PETS])
def test_a_bonus_in_plans_has_the_scale_of_the_rewards(kind):
    weights = []
    for reward_scale in (1.0, 0.01):
        torch.manual_seed(0)
        learner = kind(PAMDPSpecs(2, (), (1, 1), (-1.0, -1.0), (1.0, 1.0)), reward_scale=reward_scale)
        learner.take_bonus(Bonus(3.0, lambda state: torch.ones_like(state[..., 0])))
        weights.append(learner.policy.bonus.weight)
    assert weights == [3.0, pytest.approx(0.03)]


def test_pets_plans_before_it_has_seen_a_reward_if_disagreement_is_rewarded():
    for has_bonus in (False, True):
        torch.manual_seed(0)
        specs = PAMDPSpecs.from_env(Corridor(1))
        learner = PETS(specs, warmup_steps=32, batch_size=16, num_members=2, updates_per_step=0.1, horizon=1)
        exploration = Novelty(learner) if has_bonus else None
        assert exploration is None or exploration.network is None
        rested = TensorDict({keys.REWARD: torch.zeros(64, 1)}, [64])
        with torch.no_grad():
            batch = with_decisions(Corridor(4), 1.0).rollout(16, learner.policy, break_when_any_done=False)
        batch["next", keys.REWARD] = rested[keys.REWARD].reshape(4, 16, 1)
        learner.learn(batch, torch.ones(4, 16, dtype=torch.bool))
        assert bool(learner.policy.is_trained) == has_bonus


def test_novelty_sees_pictures_through_untrained_copies_of_the_encoder():
    words = ["env=gymnasium", "env.entry_point=toy_pictures:Mixed", "env.max_steps=5", "high=none", "low=hppo"]
    words += ["low.minibatch_size=16", "exploration=novelty", "num_envs=4", "steps_per_batch=8", "eval.layouts=2"]
    torch.manual_seed(0)
    parts = assemble(make_config([*words, "encoder.channels=[4,4,4]", "encoder.num_features=8"]))
    batch = parts.env.rollout(8, parts.policy, break_when_any_done=False)
    assert parts.agent.learn(batch)["low/bonus"] > 0.0
    parts.close()


# The group.


def test_each_options_learner_has_its_own_exploration():
    for sharing, num in (("per_option", 2), ("shared", 1)):
        words = ["high=ucb", "low=hppo", "exploration=novelty", f"agent.sharing={sharing}", "num_envs=8"]
        parts = assemble(make_config([*words, "low.minibatch_size=16", "eval.layouts=4"]))
        assert len(parts.agent.explorations) == num
        batch = parts.env.rollout(6, parts.policy, break_when_any_done=False)
        scalars = parts.agent.learn(batch)
        assert sum("bonus" in name for name in scalars) == num
        parts.close()


@pytest.mark.parametrize(("low", "kind"), pairs(("pets", "novelty")))
def test_every_learner_that_takes_an_exploration_trains_with_it_and_is_reloaded(low, kind, tmp_path):
    words = [*PLATFORM, f"low={low}", f"exploration={kind}", *SHORT.get(low, []), *SMALL, "film=false"]
    assert run(compose_config(words), tmp_path, words) == 0
    header = (tmp_path / "metrics.csv").read_text().splitlines()[0].split(",")
    is_measured_by_the_learner = (low, kind) == ("pets", "novelty")
    assert is_measured_by_the_learner or ("low/held" if kind == "held" else "low/bonus") in header
    assert hpamdp.load(tmp_path).evaluate(episodes=4)["score"] is not None


def test_a_table_of_counts_is_saved_for_training_alone(tmp_path, monkeypatch):
    words = [*PLATFORM, "low=hppo", "exploration=counts", *SHORT.get("hppo", []), *SMALL, "film=false"]
    assert run(compose_config(words), tmp_path, words) == 0
    table = 8 * CountsOptions().table_size
    policy, checkpoint = tmp_path / "policy.safetensors", tmp_path / "checkpoint.safetensors"
    assert policy.stat().st_size < 0.5 * table < table < checkpoint.stat().st_size
    agent = hpamdp.load(policy)
    monkeypatch.setattr(HierarchicalAgent, "acting_state", HierarchicalAgent.state_dict)
    agent.save(tmp_path / "whole")
    assert table < (tmp_path / "whole").stat().st_size
    scores = [hpamdp.load(file).evaluate(episodes=4) for file in (policy, checkpoint, tmp_path / "whole")]
    assert scores[0] == scores[1] == scores[2]


@pytest.mark.parametrize(("low", "kind"), pairs(("pdqn", "held"), ("hppo", "novelty")))
def test_a_run_with_exploration_resumes_to_the_last_bit(low, kind, tmp_path):
    given = ["high=ucb", f"low={low}", *SHORT.get(low, []), *SMALL, f"exploration={kind}"]
    given += ["exploration.epsilon=0.3", "exploration.epsilon_final=0.1"] if kind == "held" else []
    given += ["low.augment=false"] if (low, kind) == ("pets", "counts") else []  # to predict whole observations
    stop_and_resume(given, tmp_path, signal.SIGINT)


@pytest.mark.slow
@pytest.mark.parametrize(("low", "kind"), [("hppo", "held"), ("dlpa", "novelty")])
def test_a_run_with_exploration_in_worker_processes_resumes_to_the_last_bit(low, kind, tmp_path):
    given = ["high=ucb", f"low={low}", *SHORT.get(low, []), *SMALL, f"exploration={kind}", "collector=multi"]
    stop_and_resume(given, tmp_path, signal.SIGTERM)


# A reward that random actions do not reach. Without exploration each learner comes to rest, since steps cost something.


def corridor_hppo(specs, explore):
    learner = HPPO(specs, minibatch_size=256, hidden_dims=[64, 64], critic_hidden_dims=[64, 64], anneal_steps=60_000)
    return learner, explore(learner, 0.01), {"steps": 61_440, "num_envs": 32, "steps_per_batch": 64}, {}


def corridor_pdqn(specs, explore):
    settings = {"warmup_steps": 1000, "epsilon_steps": 3000, "batch_size": 64, "updates_per_step": 0.5, "gamma": 0.98}
    learner = PDQN(specs, hidden_dims=[32, 32], actor_lr=1e-3, critic_lr=1e-3, lr_steps=10_000, **settings)
    run = {"steps": 12_000, "num_envs": 8, "steps_per_batch": 8}
    return learner, explore(learner, 0.05), run, {"length": 10.0, "max_steps": 30}


def corridor_dlpa(specs, explore):
    settings = {"warmup_steps": 100, "batch_size": 64, "updates_per_step": 1.0, "planning_precision": "float32"}
    settings |= {"horizon": 8, "num_samples": 128, "num_elites": 16, "num_iterations": 4}
    learner = DLPA(specs, hidden_dims=[32, 32], **settings)
    run = {"steps": 800, "num_envs": 4, "steps_per_batch": 10}
    return learner, explore(learner, 0.05), run, {"length": 7.0, "max_steps": 20}


EXPLORATIONS = {
    "none": lambda learner, weight: None,
    "held": lambda learner, weight: Held(learner),
    "novelty": lambda learner, weight: Novelty(learner, weight=weight),
    "counts": lambda learner, weight: Counts(learner, weight=weight),
}


@pytest.mark.slow
@pytest.mark.parametrize("exploration", EXPLORATIONS)
@pytest.mark.parametrize("corridor", [corridor_hppo, corridor_pdqn, corridor_dlpa])
def test_a_far_reward_is_learned_with_either_exploration_and_not_without(corridor, exploration):
    torch.manual_seed(900)
    specs = PAMDPSpecs.from_env(Corridor(1))
    learner, beside, run_of, problem = corridor(specs, EXPLORATIONS[exploration])
    agent = trained(learner, beside, **run_of, **problem)[0]
    score = greedy_return(agent, **problem)
    assert score <= 0.0 if exploration == "none" else score > 0.7
