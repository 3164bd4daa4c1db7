"""Where the selector decides when options end: the bookkeeping, the option-critic and interruption."""

import math

import pytest
import torch
from tensordict import TensorDict
from test_decisions import collect
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_options import Crossing, Stepper, Toll, best_value, earned, make_meta_critic, steppers

from hpamdp import keys
from hpamdp.cards import SelectorCard
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.high_level.meta_critic import MetaCritic
from hpamdp.policies.high_level.option_critic import OptionCritic
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.specs import PAMDPSpecs

CPU = torch.device("cpu")
GAMMA = 0.9
SPECS = PAMDPSpecs.from_env(Crossing())


class Moody(Uniform):
    """Choose options at random, and end them at random."""

    card = SelectorCard(ends_options=True)

    def ends(self, td: TensorDict) -> torch.Tensor:
        return torch.rand(td.batch_size) < 0.3


def make_critic(**changes: object) -> OptionCritic:
    torch.manual_seed(0)
    options = dict(
        hidden_dims=[64], gamma=GAMMA, deliberation_cost=0.0, initial_termination=0.5, epsilon_final=0.2,
        epsilon_steps=2000, buffer_size=20_000, batch_size=128, updates_per_step=0.05, max_updates=64,
        warmup_steps=500, lr=3e-3, termination_lr=3e-3, tau=0.05,
    )  # fmt: skip
    return OptionCritic(SPECS, device=CPU, **{**options, **changes})


def ending(selector, learners=None) -> HierarchicalAgent:
    """Return an agent whose selector decides where options end."""
    learners = [Stepper(SPECS), Stepper(SPECS)] if learners is None else learners
    return HierarchicalAgent(selector, learners, SPECS, selector_ends_options=True)


def test_options_of_a_data_set_last_an_episode_and_are_stored_where_the_selector_ends_options():
    learners = [PDQN(SPECS.of_option(i), hidden_dims=(8,), warmup_steps=0, batch_size=4) for i in range(2)]
    agent = ending(Moody(SPECS), learners)
    env = with_decisions(Toll(6, start=6.0), GAMMA, math.inf)
    batch = env.rollout(3, agent.policy, break_when_any_done=False)
    given = batch.select(keys.OBSERVATION, keys.ACTION, keys.IS_DECISION)
    given["next"] = batch["next"].select(keys.OBSERVATION, keys.REWARD, keys.DONE, keys.TERMINATED, keys.IS_DECISION)
    given[keys.OPTION] = (torch.arange(6) % 2).unsqueeze(-1).expand(6, 3).clone()
    agent.add_demonstrations(given)
    agent.learn(batch)
    for i, learner in enumerate(learners):
        stored = learner.buffer[:9]
        assert (stored["option"] == i).all() and (stored["next_option"] == i).all()
        assert not stored["option_ended"].any()


def account(decision: TensorDict) -> tuple:
    """Return what a selector learns of a decision, given the last step of its option."""
    after = decision["next"]
    numbers = [decision[keys.OPTION], after[keys.OPTION_RETURN], after[keys.OPTION_STEPS], after[keys.DONE]]
    places = [after[name].argmax().item() for name in (keys.DECISION_OBSERVATION, keys.OBSERVATION)]
    return tuple(number.item() for number in numbers) + tuple(places)


@pytest.mark.parametrize("batch_steps", [5, 1])
def test_options_that_the_selector_ends_have_the_right_accounts_and_are_heard_of_once(batch_steps):
    heard_steps, heard_decisions = [], []

    class Listener(Moody):
        def learn(self, decisions):
            heard_decisions.append(decisions.clone())
            return {}

    class Hearing(Stepper):
        def learn(self, batch, mask):
            heard_steps.append(batch.clone())
            return {}

    torch.manual_seed(0)
    agent = ending(Listener(SPECS), [Hearing(SPECS), Stepper(SPECS)])
    rows = []
    env = with_decisions(Toll(4, start=6.0), GAMMA, math.inf)
    for batch in collect(env, agent.policy, 4, 60, batch_steps):
        rows.append(batch.clone())
        agent.learn(batch)
    rows = torch.cat(rows, 1)
    heard = torch.cat(heard_steps, 1)
    num_ended = 0
    expected = []
    for e in range(4):
        for t in range(60):
            row = rows[e, t]
            if row[keys.IS_DECISION]:
                total, steps, decided_at = 0.0, 0, row[keys.OBSERVATION]
            total += GAMMA**steps * row["next", keys.REWARD].item()
            steps += 1
            assert row["next", keys.OPTION_RETURN].item() == pytest.approx(total, abs=1e-5)
            assert row["next", keys.OPTION_STEPS] == steps
            assert torch.equal(row["next", keys.DECISION_OBSERVATION], decided_at)
            done = bool(row["next", keys.DONE])
            ended = t < 59 and bool(rows[e, t + 1][keys.IS_DECISION]) and not done
            num_ended += ended
            if (t + 1) % batch_steps:
                assert bool(heard[e, t]["next", keys.OPTION_ENDED]) == ended
                if not done:
                    assert heard[e, t][keys.NEXT_OPTION] == rows[e, t + 1][keys.OPTION]
            else:
                assert heard[e, t]["next", keys.OPTION_ENDED], "learners must not go on past what they know"
            if ended or done:
                expected.append(account(row))
    assert num_ended > 30
    decisions = torch.cat(heard_decisions)
    assert sorted(expected) == sorted(account(decision) for decision in decisions)


def train(selector, batch_steps: int = 10) -> HierarchicalAgent:
    agent = ending(selector)
    env = with_decisions(Crossing(50, start=6.0), GAMMA, math.inf)
    for batch in collect(env, agent.policy, 50, 180, batch_steps):
        agent.learn(batch)
    return agent


@pytest.mark.parametrize(
    ("make", "batch_steps"),
    [(make_critic, 10), (make_meta_critic, 10), pytest.param(make_meta_critic, 1, marks=pytest.mark.slow)],
    ids=["option_critic", "meta_critic", "meta_critic_one_step_a_batch"],
)
def test_options_end_where_another_one_is_better(make, batch_steps):
    agent = train(make(), batch_steps)
    assert earned(agent, GAMMA, math.inf) >= 0.95 * best_value(GAMMA, 1)
    place = torch.eye(SPECS.observation_dim)[[2, 20]]  # on land, in water
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        wrong = agent.selector.ends(TensorDict({keys.OBSERVATION: place, keys.OPTION: torch.tensor([1, 0])}, [2]))
        right = agent.selector.ends(TensorDict({keys.OBSERVATION: place, keys.OPTION: torch.tensor([0, 1])}, [2]))
    assert wrong.tolist() == [True, True]
    if isinstance(agent.selector, MetaCritic):  # without a deliberation cost nothing keeps the right option going
        assert right.tolist() == [False, False]


def test_a_deliberation_cost_makes_options_last():
    agent = train(make_critic(deliberation_cost=0.02, termination_lr=1e-2))
    assert earned(agent, GAMMA, math.inf) >= 0.95 * best_value(GAMMA, 1)
    place = torch.eye(SPECS.observation_dim)[[4, 20]]
    beta = agent.selector.beta(place, torch.tensor([0, 1]), None)
    assert beta.max() < 0.2


def step_rows(critic: OptionCritic) -> TensorDict:
    """Return three steps: one within an episode, one that ends it, and one that a time limit cuts off."""
    state = torch.eye(SPECS.observation_dim)
    done = torch.tensor([[False], [True], [True]])
    after = {
        keys.OBSERVATION: state[1:4],
        keys.REWARD: torch.tensor([[1.0], [2.0], [3.0]]),
        keys.DONE: done,
        keys.TERMINATED: torch.tensor([[False], [True], [False]]),
        keys.OPTION_ENDED: torch.tensor([[True], [False], [False]]),
    }
    rows = TensorDict({keys.OBSERVATION: state[:3], keys.OPTION: torch.tensor([0, 1, 1]), "next": after}, [3])
    return critic.rows(rows)


@pytest.mark.parametrize("decides", [True, False])
def test_the_targets_of_the_option_critic_equal_those_by_hand(decides):
    critic = make_critic(initial_termination=0.3)
    critic.decides_ends = decides
    rows = step_rows(critic)
    q = critic.target_critic(rows["next_state"])[0]
    beta = critic.beta(rows["next_state"], rows["option"], None)[0] if decides else 1.0
    expected = 1.0 + GAMMA * ((1.0 - beta) * q[0] + beta * q.max())
    assert critic.target(rows).tolist() == pytest.approx([expected.item(), 2.0, 3.0])


def test_ends_that_are_sure_and_wrong_are_learned_anew():
    critic = make_critic(deliberation_cost=0.01)
    with torch.no_grad():
        critic.critic[-1].weight.zero_()
        critic.critic[-1].bias.copy_(torch.tensor([0.0, 0.2]))  # so that option 0 has to end, and option 1 has not
        critic.termination[-1].weight.zero_()
        critic.termination[-1].bias.copy_(torch.tensor([-20.0, 20.0]))
    rows = TensorDict(
        {
            "next_state": torch.rand(64, SPECS.observation_dim),
            "option": torch.arange(64) % 2,
            "discount": torch.full((64,), GAMMA),
        },
        [64],
    )
    for _ in range(1000):
        critic.update_termination(rows)
    beta = critic.beta(rows["next_state"], rows["option"], None)
    assert (beta[0::2] > 0.9).all() and (beta[1::2] < 0.1).all()


def test_ends_are_not_learned_where_the_episode_is_over_or_the_option_forbidden():
    critic = make_critic()
    before = [parameter.clone() for parameter in critic.termination.parameters()]
    rows = TensorDict(
        {
            "next_state": torch.rand(64, SPECS.observation_dim),
            "option": torch.arange(64) % 2,
            "discount": torch.where(torch.arange(64) < 32, 0.0, GAMMA),
            "next_option_mask": torch.arange(64).unsqueeze(-1) % 2 != torch.arange(2),
        },
        [64],
    )
    rows["next_option_mask"][:32] = True
    critic.update_termination(rows)
    assert all(torch.equal(old, new) for old, new in zip(before, critic.termination.parameters(), strict=True))


def test_options_end_with_the_initial_probability_as_often_as_they_are_random():
    critic = make_critic(initial_termination=0.3, warmup_steps=0, epsilon_steps=1, epsilon_final=0.2)
    critic.num_steps.fill_(1)
    td = TensorDict({keys.OBSERVATION: torch.rand(4000, SPECS.observation_dim), keys.OPTION: torch.arange(4000) % 2})
    td.batch_size = [4000]
    with torch.no_grad():
        critic.termination[-1].bias.copy_(torch.tensor([-30.0, 30.0]))  # option 0 never ends, option 1 always does

    def shares() -> list[float]:
        is_ended = critic.ends(td).float()
        return [is_ended[0::2].mean().item(), is_ended[1::2].mean().item()]

    assert shares() == pytest.approx([0.2 * 0.3, 0.8 + 0.2 * 0.3], abs=0.04)
    critic.practice.fill_(0.5)
    assert shares() == pytest.approx([0.3, 0.3], abs=0.04)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert shares() == [0.0, 1.0]


def test_the_meta_critic_ends_the_best_option_too_as_often_as_it_chooses_at_random():
    critic = make_meta_critic()
    critic.num_decisions.fill_(10_000)  # the probability of a random option is 0.2
    with torch.no_grad():
        critic.critics.layers[-1].bias.copy_(torch.tensor([9.0, -9.0]))
    td = TensorDict({keys.OBSERVATION: torch.rand(4000, SPECS.observation_dim), keys.OPTION: torch.arange(4000) % 2})
    td.batch_size = [4000]

    def shares() -> list[float]:
        is_ended = critic.ends(td).float()
        return [is_ended[0::2].mean().item(), is_ended[1::2].mean().item()]

    assert shares() == pytest.approx([0.2, 1.0], abs=0.04)
    critic.practice.fill_(0.5)
    assert shares() == [1.0, 1.0]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert shares() == [0.0, 1.0]


def test_options_of_a_fixed_length_are_interrupted_by_nobody():
    torch.manual_seed(0)
    agent = steppers(make_meta_critic(), SPECS)
    rows = with_decisions(Toll(4, start=0.0), GAMMA, 3).rollout(6, agent.policy)
    assert rows[keys.IS_DECISION][0].flatten().tolist() == [True, False, False] * 2
