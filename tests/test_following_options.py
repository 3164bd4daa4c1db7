"""Where an option ends inside its episode, what follows is worth what it is worth under the option chosen next."""

from __future__ import annotations

import pytest
import torch
from conftest import make_config
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, exploration_type
from toy_options import Toll, steppers

from hpamdp import keys
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent, with_option
from hpamdp.policies.base import Selector, States
from hpamdp.policies.high_level.actor import Actor
from hpamdp.policies.high_level.fixed import Fixed
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.specs import PAMDPSpecs

SPECS = PAMDPSpecs(2, ("first", "second"), (1, 1), (0.0, 0.0), (1.0, 1.0))
CPU = torch.device("cpu")
GAMMA = 0.5
REPLAY = ["low.warmup_steps=0", "low.updates_per_step=0.15", "low.batch_size=32", "low.critic_lr=0.02"]
SMALL = ["low.hidden_dims=[16]", f"low.gamma={GAMMA}"]
MODEL = ["low.warmup_steps=1", "low.updates_per_step=0.15", "low.batch_size=32", "low.horizon=1"]
MODEL += ["low.end_values=true", "low.end_value_lr=0.02", "low.end_value_tau=0.3"]
SMALL_PETS = ["low.transition_dims=[16]", "low.outcome_dims=[16]", "low.num_members=2", "low.num_samples=4"]
# Soft values that are nearly those of the best actions.
COLD = ["low.discrete_temperature=1e-4", "low.parameter_temperature=1e-4"]
COLD += ["low.tune_discrete_temperature=false", "low.tune_parameter_temperature=false"]
LEARNERS = {
    "hppo": [*SMALL, "low.critic_hidden_dims=[16]", "low.minibatch_size=64", "low.lr=0.02", "low.lr_final=0.02"],
    "pdqn": [*SMALL, *REPLAY, "low.critic_tau=0.3"],
    "paddpg": [*SMALL, *REPLAY, "low.tau=0.3"],
    "hsac": [*SMALL, *REPLAY, "low.tau=0.3", *COLD],
    "hyar": [*SMALL, *REPLAY, "low.warmup_steps=64", "low.tau=0.3", "low.codec_pretrain_updates=2"],
    "iql": [*SMALL, *REPLAY, "low.tau=0.3"],
    "td3_bc": [*SMALL, *REPLAY, "low.tau=0.3"],
    "dlpa": [*SMALL, *MODEL, "low.num_samples=8", "low.num_elites=4", "low.num_iterations=1"],
    "pets": [f"low.gamma={GAMMA}", *MODEL, *SMALL_PETS, "low.greedy_samples=4", "low.num_iterations=1"],
    "qpamdp": [f"low.gamma={GAMMA}", "low.features=null", "low.warmup_steps=1", "low.phi_order=1", "low.psi_order=1"],
}


def make_agent(low: str, selector: Selector, *, is_shared: bool, words: list[str] | None = None) -> HierarchicalAgent:
    torch.manual_seed(0)
    words = LEARNERS[low] if words is None else words
    config = make_config([f"low={low}", "high=none", "env=platform", *words])
    specs = SPECS.with_option_observed() if is_shared else SPECS
    learners = [config.low.build(specs=specs, device=CPU) for _ in range(1 if is_shared else 2)]
    return HierarchicalAgent(selector, learners, SPECS, is_shared=is_shared)


def value(agent: HierarchicalAgent, option: int, observation: torch.Tensor) -> float:
    """Return the mean value of observations `[N, 2]` under an option."""
    if agent.is_shared:
        one_hot = torch.nn.functional.one_hot(torch.full((len(observation),), option), 2)
        return agent.learners[0].value(States(torch.cat([observation, one_hot], -1))).mean().item()
    return agent.learners[option].value(States(observation)).mean().item()


def two_options(agent: HierarchicalAgent, num: int, num_steps: int = 2) -> TensorDict:
    """Return `[num, num_steps]` steps of options that take one each: the first one pays 0, the second one pays 1.

    The second option follows the first one and ends the episode.
    """
    observation = torch.rand(num, 2 + 1, 2) * 2 - 1
    td = TensorDict({keys.OBSERVATION: observation[:, :-1], keys.OPTION: torch.tensor([0, 1]).repeat(num, 1)}, [num, 2])
    with torch.no_grad():
        agent.router(td)
    done = torch.tensor([False, True]).repeat(num, 1).unsqueeze(-1)
    after = {
        keys.OBSERVATION: observation[:, 1:],
        keys.REWARD: done.float(),
        keys.DONE: done,
        keys.TERMINATED: done.clone(),
        keys.TRUNCATED: torch.zeros_like(done),
        keys.IS_DECISION: torch.ones_like(done),
        keys.OPTION_ENDED: torch.ones_like(done),
        keys.OPTION_RETURN: done.float(),
        keys.OPTION_STEPS: torch.ones_like(done).long(),
        keys.DECISION_OBSERVATION: td[keys.OBSERVATION],
    }
    return td.set("next", TensorDict(after, [num, 2]))


@pytest.mark.parametrize("is_shared", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["per_option", "shared"])
@pytest.mark.parametrize("low", LEARNERS)
def test_an_option_is_worth_the_discounted_value_of_the_option_that_follows_it(low, is_shared):
    agent = make_agent(low, Fixed(SPECS, option="second"), is_shared=is_shared)
    for _ in range(5):
        batch = two_options(agent, 64)
        agent.learn(batch)
    for _ in range(5):  # the next option is not in the batch
        batch = two_options(agent, 64)
        agent.learn(batch[:, :1])
        agent.learn(batch[:, 1:])
    observation = torch.rand(500, 2) * 2 - 1
    assert value(agent, 1, observation) == pytest.approx(1.0, abs=0.15)
    assert value(agent, 0, observation) == pytest.approx(GAMMA, abs=0.15)


@pytest.mark.parametrize("is_shared", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["per_option", "shared"])
@pytest.mark.parametrize("low", ["dlpa", "pets"])
def test_a_plan_ends_in_the_value_of_the_option_that_follows_and_in_nothing_after_a_termination(low, is_shared):
    agent = make_agent(low, Fixed(SPECS, option="second"), is_shared=is_shared)
    for _ in range(8):
        agent.learn(two_options(agent, 64))
    observation = torch.rand(500, 2) * 2 - 1
    if is_shared:
        observation = torch.cat([observation, torch.tensor([1.0, 0.0]).expand(500, 2)], -1)
    of_first = agent.learners[0].end_values
    with torch.no_grad():
        assert of_first(observation).mean().item() == pytest.approx(1.0, abs=0.15), (
            "not what the option that ended is worth"
        )
    nothing = torch.zeros(500)
    loss, _ = of_first.loss(observation, observation, nothing, nothing, nothing + 5.0)
    gradients = torch.autograd.grad(loss, [*of_first.end.parameters()])
    assert all((gradient == 0.0).all() for gradient in gradients)


@pytest.mark.parametrize("is_shared", [False, True], ids=["per_option", "shared"])
def test_the_advantages_of_hppo_count_what_the_options_earn_that_follow(is_shared):
    agent = make_agent("hppo", Fixed(SPECS, option="second"), is_shared=is_shared)
    batch = torch.cat([two_options(agent, 4)] * 2, 1)  # first, second, end of the episode, first, second
    batch["next", keys.REWARD] = torch.tensor([1.0, 2.0, 4.0, 8.0]).expand(4, 4).unsqueeze(-1).clone()
    batch = agent.next_options.with_next_option(batch)
    seen = with_option(batch, 2) if is_shared else batch
    of_option = [
        agent.next_options.value(States(seen[keys.OBSERVATION][:, t]), batch[keys.OPTION][:, t]) for t in range(4)
    ]
    is_mine = torch.ones(4, 4, dtype=torch.bool) if is_shared else batch[keys.OPTION] == 0
    advantage, target = agent.learners[0].advantages(seen, is_mine)
    for t in (0, 2):
        first, second = batch["next", keys.REWARD][:, t : t + 2].squeeze(-1).unbind(1)
        after = agent.next_options.value(States(seen["next", keys.OBSERVATION][:, t]), torch.ones(4).long())
        expected = first + GAMMA * after - of_option[t] + GAMMA * 0.95 * (second - of_option[t + 1])
        torch.testing.assert_close(advantage[:, t], expected)
        torch.testing.assert_close(target[:, t], expected + of_option[t])


def changing_options(option_length: int | None = 2) -> tuple[HierarchicalAgent, TensorDict]:
    """Return an agent with random options and 60 of its steps in each of 4 environments, with resets among them."""
    torch.manual_seed(0)
    env = with_decisions(Toll(4, start=6.0), 0.9, option_length)
    specs = PAMDPSpecs.from_env(env)
    agent = steppers(Uniform(specs), specs)
    return agent, env.rollout(60, agent.policy, break_when_any_done=False)


def heard_by_learners(agent: HierarchicalAgent, batch: TensorDict, monkeypatch) -> TensorDict:
    """Return the batch that the agent hands on to its learners."""
    heard = []
    monkeypatch.setattr(type(agent.learners[0]), "learn", lambda self, batch, mask: heard.append(batch) or {})
    agent.learn(batch)
    return heard[0]


def test_learners_are_told_the_option_that_holds_in_the_next_state(monkeypatch):
    agent, batch = changing_options()
    heard = heard_by_learners(agent, batch, monkeypatch)
    goes_on = ~batch["next", keys.DONE][:, :-1].squeeze(-1)
    assert (~goes_on).sum() > 10
    assert torch.equal(heard[keys.NEXT_OPTION][:, :-1][goes_on], batch[keys.OPTION][:, 1:][goes_on])
    assert keys.NEXT_OPTION not in batch.keys(True), "the batch belongs to the collector"


def test_the_option_that_follows_a_batch_is_the_selectors_greedy_one(monkeypatch):
    agent, batch = changing_options()
    monkeypatch.setattr(agent.selector, "select", lambda td: (td["observation"].argmax(-1) % 2 == 0).long())
    monkeypatch.setattr(agent.selector, "option_probabilities", lambda td: None)
    heard = heard_by_learners(agent, batch, monkeypatch)
    ended = batch["next", keys.OPTION_ENDED].squeeze(-1)
    missing = ended & batch["next", keys.DONE].squeeze(-1)
    missing[:, -1] = ended[:, -1]
    assert missing[:, -1].any() and missing[:, :-1].any()
    expected = (batch["next", keys.OBSERVATION].argmax(-1) % 2 == 0).long()
    assert torch.equal(heard[keys.NEXT_OPTION][missing], expected[missing])


def test_options_that_last_an_episode_cost_nothing(monkeypatch):
    agent, batch = changing_options(None)
    assert keys.OPTION_ENDED not in batch.keys() and ("next", keys.OPTION_ENDED) not in batch.keys(True)
    assert heard_by_learners(agent, batch, monkeypatch) is batch
    agent = make_agent("pdqn", Fixed(SPECS, option="second"), is_shared=False)
    agent.learn(two_options(agent, 8).exclude(("next", keys.OPTION_ENDED)))
    stored = {"state", "discrete", "unit", "reward", "next_state", "discount"}
    assert set(agent.learners[0].buffer[:].keys()) == stored


class OfSign(Selector):
    """Choose the second option where the first entry is positive."""

    def select(self, td: TensorDict) -> torch.Tensor:
        return (td[keys.OBSERVATION][..., 0] > 0.0).long()


class OfTold(OfSign):
    """Is told something that no replay buffer holds."""

    def __init__(self) -> None:
        super().__init__(SPECS)
        self.in_keys = [*self.in_keys, keys.ORACLE_OPTION]


class Softly(OfSign):
    """Choose the second option with a probability that the first entry gives."""

    def option_probabilities(self, td: TensorDict) -> torch.Tensor:
        second = td[keys.OBSERVATION][..., 0].sigmoid()
        return torch.stack([1.0 - second, second], -1)


@pytest.mark.parametrize("selector", [OfSign, Softly])
@pytest.mark.parametrize("is_shared", [False, True], ids=["per_option", "shared"])
def test_a_replayed_step_is_worth_the_mean_over_the_options_that_the_selector_would_choose_now(is_shared, selector):
    words = [*LEARNERS["pdqn"], "low.target_smoothing=0"]
    agent = make_agent("pdqn", selector(SPECS), is_shared=is_shared, words=words)
    state = torch.rand(20, 2) * 2 - 1
    seen = torch.cat([state, torch.tensor([[1.0, 0.0]]).expand(20, 2)], -1) if is_shared else state
    is_ended, chosen_then = torch.rand(20) < 0.7, torch.randint(2, (20,))
    rows = {"next_state": seen, "option_ended": is_ended, "next_option": chosen_then, "option": chosen_then}
    expected = []
    for i in range(20):
        now = float(state[i, 0].sigmoid()) if selector is Softly else float(state[i, 0] > 0.0)
        second = now if is_ended[i] else 0.0
        first_value, second_value = (value(agent, option, state[i : i + 1]) for option in range(2))
        expected.append((1.0 - second) * first_value + second * second_value)
    assert agent.learners[0].next_value(TensorDict(rows, [20])).tolist() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("is_shared", [False, True], ids=["per_option", "shared"])
def test_the_option_after_the_last_step_of_a_batch_is_drawn_from_a_stochastic_selector(is_shared):
    torch.manual_seed(0)
    agent = make_agent("hppo", Softly(SPECS), is_shared=is_shared)
    batch = two_options(agent, 4000)
    is_end = torch.ones(*batch.shape, 1, dtype=torch.bool)
    batch["next", keys.OBSERVATION] = torch.ones_like(batch["next", keys.OBSERVATION])
    batch["next", keys.OPTION_ENDED], batch["next", keys.DONE] = is_end, ~is_end
    followed = agent.next_options.with_next_option(batch)[keys.NEXT_OPTION][:, -1]
    agent.learn(batch[:8])
    assert followed.float().mean() == pytest.approx(torch.tensor(1.0).sigmoid().item(), abs=0.03)


def test_the_actor_and_uniform_choices_state_the_probabilities_of_their_options():
    torch.manual_seed(0)
    is_due = torch.ones(1, 1, dtype=torch.bool)
    td = TensorDict({keys.OBSERVATION: torch.rand(1, 2), keys.IS_DECISION: is_due}, [1]).expand(4000)
    for selector in (Actor(SPECS), Uniform(SPECS)):
        often = selector.select(td).bincount(minlength=2) / 4000
        torch.testing.assert_close(selector.option_probabilities(td)[0], often, atol=0.03, rtol=0.0)


def test_a_replayed_step_is_followed_by_the_option_of_that_time_if_the_selector_needs_more_than_the_observation():
    agent = make_agent("pdqn", OfTold(), is_shared=False)
    option = torch.randint(2, (20,))
    assert torch.equal(agent.learners[0].next_options.choose(torch.rand(20, 2), option, option), option)
    agent = make_agent("pdqn", OfSign(SPECS), is_shared=False)
    assert agent.learners[0].next_options.choose(torch.rand(20, 2), option, option).tolist() == [1] * 20


def test_asking_the_selector_again_leaves_its_exploration_alone():
    agent = make_agent("pdqn", OfSign(SPECS), is_shared=False)
    seen = []
    agent.selector.select = lambda td: seen.append(exploration_type()) or td[keys.OBSERVATION][..., 0].long()
    agent.learners[0].next_options.choose(torch.rand(20, 2), *torch.zeros(2, 20).long())
    assert seen == [ExplorationType.DETERMINISTIC] and exploration_type() != ExplorationType.DETERMINISTIC


def test_n_step_returns_end_with_the_option_and_go_on_with_the_next_one():
    agent = make_agent("pdqn", Fixed(SPECS, option="second"), is_shared=False, words=["low.n_step=3", "low.gamma=0.5"])
    batch = torch.cat([two_options(agent, 4)] * 2, 1)
    batch[keys.OPTION] = torch.tensor([0, 0, 1, 1]).repeat(4, 1)
    ended = torch.tensor([False, True, False, False]).repeat(4, 1).unsqueeze(-1)
    done = torch.tensor([False, False, False, True]).repeat(4, 1).unsqueeze(-1)
    reward = torch.tensor([1.0, 2.0, 4.0, 8.0]).repeat(4, 1).unsqueeze(-1)
    batch["next"].update({keys.OPTION_ENDED: ended, keys.IS_DECISION: ended | done, keys.REWARD: reward})
    batch["next"].update({keys.DONE: done, keys.TERMINATED: done})
    rows = agent.learners[0].transitions(agent.next_options.with_next_option(batch))[0]
    assert rows["reward"].tolist() == [2.0, 2.0, 8.0, 8.0]
    assert rows["discount"].tolist() == [0.25, 0.5, 0.0, 0.0]
    assert rows["option_ended"].tolist() == [True, True, False, False]
    assert rows["next_option"].tolist()[:2] == [1, 1]


@pytest.mark.parametrize("phase", [0, 1], ids=["sarsa", "parameters"])
def test_what_q_pamdp_learns_depends_on_no_step_of_another_option(phase):
    def learned(scale: float) -> dict[str, torch.Tensor]:
        agent = make_agent("qpamdp", Fixed(SPECS, option="second"), is_shared=False)
        learner = agent.learners[0]
        agent.learn(two_options(agent, 64))
        learner.policy.w.normal_(generator=torch.Generator().manual_seed(2))
        learner.phase.fill_(phase)
        learner.enac.restart(learner.policy.theta.numel() + learner.policy.w.shape[1], torch.ones(64) == 1)
        parts = [two_options(agent, 64) for _ in range(3)]
        batch = torch.cat(parts, 1)
        batch["next", keys.DONE] = torch.tensor([False] * 5 + [True]).repeat(64, 1).unsqueeze(-1)
        batch["next", keys.TERMINATED] = batch["next", keys.DONE].clone()
        batch["next", keys.REWARD] = torch.rand(64, 6, 1)
        is_other = batch[keys.OPTION] == 1
        # Nothing follows that the other steps could change but by what this learner makes of them itself.
        agent.learners[1].value = lambda states, is_target: torch.full((len(states.observation),), 3.0)
        batch["next", keys.REWARD][is_other] *= scale
        batch[keys.OBSERVATION][is_other] = batch[keys.OBSERVATION][is_other] * scale
        batch["raw_parameters"][is_other] *= scale
        learner.learn(agent.next_options.with_next_option(batch), ~is_other)
        return {name: value.clone() for name, value in learner.named_buffers() if "traces" not in name}

    torch.manual_seed(0)
    once, again = learned(1.0), learned(-0.5)
    for name, buffer in once.items():
        if name not in ("enac.regressors", "enac.returns"):  # of the episodes that run
            torch.testing.assert_close(buffer, again[name], msg=name)


def test_an_option_is_an_episode_of_the_natural_actor_critic_and_what_follows_belongs_to_its_return():
    agent = make_agent("qpamdp", Fixed(SPECS, option="second"), is_shared=False)
    learner = agent.learners[0]
    agent.learn(two_options(agent, 64))
    agent.learners[1].value = lambda states, is_target: torch.full((len(states.observation),), 3.0)
    batch = two_options(agent, 64)
    rows = learner.rows(agent.next_options.with_next_option(batch), batch[keys.OPTION] == 0)
    assert rows["reward"][:, 0].tolist() == pytest.approx([GAMMA * 3.0] * 64)
    assert rows["done"].all() and rows["terminated"].all()
