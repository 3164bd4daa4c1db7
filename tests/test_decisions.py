"""DecisionTracker gives the semi-MDP view of episodes, and options that end inside an episode are worth choosing."""

from typing import Literal

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import check_env_specs
from toy_options import Crossing, Listener, Toll, best_value, earned, make_meta_critic, steppers

from hpamdp import keys
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.env.option_choice import OptionChoiceEnv
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Selector
from hpamdp.policies.high_level.actor import Actor
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.random import Random
from hpamdp.specs import PAMDPSpecs


def random_agent(env):
    specs = PAMDPSpecs.from_env(env)
    selector = Uniform(specs) if specs.num_options else None
    return HierarchicalAgent(selector, [Random(specs) for _ in range(max(1, specs.num_options))], specs)


def collect(env, policy, num_envs: int, steps: int, batch_steps: int):
    """Yield the batches `[num_envs, batch_steps]` of a collector."""
    collector = Collector(
        env,
        policy,
        frames_per_batch=num_envs * batch_steps,
        total_frames=num_envs * steps,
        auto_register_policy_transforms=False,
    )
    yield from collector
    collector.shutdown()


def test_specs_of_a_tracked_environment_hold():
    check_env_specs(with_decisions(BoatDockEnv(3, controller="congruent")))
    check_env_specs(with_decisions(Crossing(3, start=6.0), 0.9, 2))


def check_accounts(rows: TensorDict, gamma: float, option_length: int | Literal["chosen"] | None = None) -> list:
    """Compare every key of the tracker in one environment's rows with sums that are made here.

    Return the steps of each option, and whether it ended before its episode.
    """
    is_due = True
    is_first = True
    options = []
    for row in rows:
        assert row[keys.IS_DECISION].item() == is_due
        if is_first:
            episode_return = 0.0
            episode_steps = 0
        if is_due:
            total = 0.0
            steps = 0
            decided_at = row[keys.OBSERVATION]
            option = row[keys.OPTION]
            length = row[keys.OPTION_LENGTH] if option_length == "chosen" else option_length
        assert row[keys.OPTION] == option, "the option changed where no decision was due"
        assert option_length != "chosen" or row[keys.OPTION_LENGTH] == length
        reward = row["next", keys.REWARD].item()
        total += gamma**steps * reward
        episode_return += reward
        steps += 1
        episode_steps += 1
        is_first = row["next", keys.DONE].item()
        is_due = is_first or steps == length
        if is_due:
            options.append((steps, not is_first))
        assert length is None or row["next", keys.OPTION_ENDED].item() == (steps == length)
        assert row["next", keys.IS_DECISION].item() == is_due
        assert row["next", keys.OPTION_STEPS].item() == steps
        assert row["next", keys.OPTION_RETURN].item() == pytest.approx(total, abs=1e-5)
        assert row["next", keys.EPISODE_RETURN].item() == pytest.approx(episode_return, abs=1e-5)
        assert row["next", keys.EPISODE_STEPS].item() == episode_steps
        assert torch.equal(row["next", keys.DECISION_OBSERVATION], decided_at)
    return options


@pytest.mark.parametrize("gamma", [1.0, 0.9])
def test_option_returns_are_right_across_collected_batches(gamma):
    torch.manual_seed(0)
    env = with_decisions(BoatDockEnv(4), gamma)
    rows = torch.cat([batch.clone() for batch in collect(env, random_agent(env).policy, 4, 60, 3)], 1)
    assert rows.shape == (4, 60)
    for environment in rows:
        assert not any(is_cut for _, is_cut in check_accounts(environment, gamma))


@pytest.mark.parametrize(("option_length", "batch_steps"), [(1, 3), (5, 7), (100, 3)])
def test_returns_of_options_of_a_fixed_length_are_right_across_collected_batches(option_length, batch_steps):
    torch.manual_seed(0)
    env = with_decisions(Toll(4, start=6.0), 0.9, option_length)
    specs = PAMDPSpecs.from_env(env)
    rows = [batch.clone() for batch in collect(env, steppers(Uniform(specs), specs).policy, 4, 63, batch_steps)]
    rows = torch.cat(rows, 1)
    assert rows["next", keys.DONE].sum() > 10
    for environment in rows:
        num_cut = sum(is_cut for _, is_cut in check_accounts(environment, 0.9, option_length))
        assert (num_cut > 5) == (option_length < 100)


@pytest.mark.parametrize("is_choice", [False, True], ids=["both levels", "high level"])
@pytest.mark.parametrize("mask", [None, [True, False, True]], ids=["whole", "part"])
def test_layouts_given_to_a_reset_reach_the_boats(mask, is_choice):
    env = BoatDockEnv(3, seed=1)
    if is_choice:
        env = OptionChoiceEnv(Random(PAMDPSpecs.from_env(env)).policy, env)
    env = with_decisions(env)
    before = env.reset()
    layout = TensorDict({"start": points(560.0), "goal": points(700.0)}, [3])
    if mask is not None:
        layout["_reset"] = torch.tensor(mask).unsqueeze(-1)
    after = env.reset(before.clone().update(layout))
    is_new = torch.ones(3, dtype=torch.bool) if mask is None else torch.tensor(mask)
    given = BoatDockEnv(3, seed=1).reset(layout.exclude("_reset"))
    expected = torch.where(is_new.unsqueeze(-1), given[keys.OBSERVATION], before[keys.OBSERVATION])
    assert torch.equal(after[keys.OBSERVATION], expected)
    assert not torch.equal(env.reset()[keys.OBSERVATION], after[keys.OBSERVATION])  # only in that reset


def points(x):
    return torch.tensor([[x, 480.0 + 10.0 * i] for i in range(3)])


def test_the_selector_learns_from_every_decision_once_and_the_oldest_first():
    torch.manual_seed(0)
    env = with_decisions(Toll(4, start=6.0), 0.9, 2)
    specs = PAMDPSpecs.from_env(env)
    agent = steppers(Listener(specs), specs)
    rows = []
    for batch in collect(env, agent.policy, 4, 60, 5):
        rows.append(batch.clone())
        agent.learn(batch)
    rows = torch.cat(rows, 1)
    heard = torch.cat(agent.selector.heard)
    is_end = rows["next", keys.IS_DECISION].squeeze(-1)
    assert len(heard) == is_end.sum() > 60
    expected = torch.cat([rows[:, t][is_end[:, t]]["next", keys.OPTION_RETURN] for t in range(60)])
    assert torch.equal(heard["next", keys.OPTION_RETURN], expected)


GAMMA = 0.9


def test_the_best_value_of_the_crossing_is_that_worked_out_by_hand():
    # Options of two steps: walk 2, walk 1.25, swim 2, and arrive with the first step of the last. Of three steps: walk
    # 3, swim 3. Of an episode: 3 steps where the option suits, 12 where it does not.
    assert best_value(GAMMA, 2) == pytest.approx(GAMMA**6)
    assert best_value(GAMMA, 3) == pytest.approx(GAMMA**5)
    assert best_value(GAMMA, Crossing.max_steps) == pytest.approx(GAMMA**14)


def trained(selector: Selector, option_length: int | None, num_batches: int) -> float:
    """Train a selector on Crossing and return the discounted return of its greedy choices."""
    env = with_decisions(Crossing(50, start=6.0), GAMMA, option_length)
    agent = steppers(selector, selector.specs)
    for batch in collect(env, agent.policy, 50, 10 * num_batches, 10):
        agent.learn(batch)
    return earned(agent, GAMMA, option_length)


def make_actor() -> Actor:
    torch.manual_seed(0)
    options = dict(hidden_dims=[64], epochs=4, minibatch_size=128, clip=0.2, entropy=0.01, lr=3e-3, max_grad_norm=0.5)
    return Actor(PAMDPSpecs.from_env(Crossing()), device=torch.device("cpu"), gamma=GAMMA, **options)


def test_meta_critic_chooses_options_of_a_fixed_length_optimally_and_better_than_for_whole_episodes():
    anew, whole = (trained(make_meta_critic(updates_per_decision=0.15), length, 12) for length in (2, None))
    assert anew >= 0.95 * best_value(GAMMA, 2)
    assert whole <= best_value(GAMMA, Crossing.max_steps) + 1e-6 < 0.5 * anew


def test_actor_chooses_options_of_a_fixed_length_optimally():
    assert trained(make_actor(), 2, 24) >= 0.95 * best_value(GAMMA, 2)


def test_an_environment_of_choices_closes_the_one_that_it_wraps():
    inner = BoatDockEnv(2)
    OptionChoiceEnv(Random(PAMDPSpecs.from_env(inner)).policy, inner).close()
    assert inner.is_closed


def scaled_pendulums(num_envs: int) -> GymnasiumEnv:
    settings = {"staggered": True, "observation_scaling": "running", "reward_scaling": 0.9, "max_steps": 3}
    return GymnasiumEnv(num_envs, id="Pendulum-v1", seed=2, **settings)


@pytest.mark.parametrize("option_length", [None, 2])
@pytest.mark.parametrize("make", [lambda num: PlatformEnv(num, seed=2, max_steps=3), scaled_pendulums])
def test_a_step_with_a_restart_returns_what_torchrls_own_does(make, option_length):
    fast, slow = (with_decisions(make(50), 0.9, option_length) for _ in range(2))
    slow.base_env.step_and_restart = lambda td: None
    one, other = fast.reset(), slow.reset()
    for _ in range(7):
        action = fast.rand_action(one.clone()).select(keys.ACTION)
        mark = torch.rand(50, 3)  # what a policy keeps from step to step
        fast_step, one = fast.step_and_maybe_reset(one.update(action).set("mark", mark))
        slow_step, other = slow.step_and_maybe_reset(other.update(action.clone()).set("mark", mark))
        assert set(fast_step.keys(True)) == set(slow_step.keys(True)) and set(one.keys(True)) == set(other.keys(True))
        assert (fast_step == slow_step).all() and (one == other).all()
