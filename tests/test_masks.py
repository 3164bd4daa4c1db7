"""Forbidden actions and options are neither taken nor counted in a target; options can be sets of actions."""

from __future__ import annotations

import math
import shutil

import pytest
import torch
from conftest import OF_EACH_KIND, choices, make_config
from tensordict import TensorDict
from test_following_options import LEARNERS
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_masks import NUM_DISCRETE, Forbidden

from hpamdp import keys
from hpamdp.env.base import ProblemError
from hpamdp.env.decisions import DecisionEnv, with_decisions
from hpamdp.policies.agent import HierarchicalAgent, OptionValues
from hpamdp.policies.base import Selector, States
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.random import Random
from hpamdp.policies.masks import masked_logits
from hpamdp.specs import PAMDPSpecs

CPU = torch.device("cpu")
SHORT = {
    **LEARNERS,
    "hyar": [*LEARNERS["hyar"], "low.warmup_steps=100", "low.epsilon_steps=100"],
    "dlpa": [
        *("low.hidden_dims=[16]", "low.warmup_steps=100", "low.num_samples=32", "low.num_elites=8"),
        *("low.num_iterations=2", "low.horizon=2", "low.batch_size=32"),
    ],
    "pets": [
        *("low.transition_dims=[16]", "low.outcome_dims=[16]", "low.num_members=2", "low.warmup_steps=100"),
        *("low.batch_size=32", "low.max_sequences=9", "low.num_kept=2", "low.num_samples=8", "low.greedy_samples=8"),
        *("low.num_elites=2", "low.num_iterations=2", "low.horizon=2"),
    ],
    "random": [],
}
CASES = {
    **{name: (name, words) for name, words in SHORT.items()},
    "hyar_nearest": ("hyar", [*SHORT["hyar"], "low.discrete=nearest"]),
    "pdqn_n_step": ("pdqn", [*SHORT["pdqn"], "low.n_step=3", "low.double_q=true"]),
    "paddpg_twin": ("paddpg", [*SHORT["paddpg"], "low.twin=true"]),
}


def make_learner(name: str, specs: PAMDPSpecs):
    torch.manual_seed(0)
    low, words = CASES[name]
    words = [word for word in words if "updates_per_step" not in word]
    rate = ["low.updates_per_step=0.1"] if any("batch_size" in word for word in words) and low != "hppo" else []
    return make_config([f"low={low}", "high=none", "env=platform", *words, *rate]).low.build(specs=specs, device=CPU)


def play_and_learn(env: DecisionEnv, agent: HierarchicalAgent, num_batches: int) -> None:
    """Collect and learn, exploring; the selector's first choices are uniform. Then play greedily."""
    td = env.reset()
    for i in range(num_batches):
        if agent.selector is not None:
            agent.selector.practice.fill_(float(i == 0) / agent.selector.specs.num_options)
        with torch.no_grad():
            batch = env.rollout(12, agent.policy, break_when_any_done=False, auto_reset=False, tensordict=td)
        td = env.step_mdp(batch[:, -1])
        agent.learn(batch)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        env.rollout(8, agent.policy, break_when_any_done=False)


@pytest.mark.parametrize("name", CASES)
def test_a_forbidden_action_is_never_taken(name):
    play_with_forbidden_actions(name)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("name", sorted({*CASES} - {"random", "qpamdp"}))
def test_compiled_updates_take_no_forbidden_action(name):
    play_with_forbidden_actions(name, is_compiled=True)


def play_with_forbidden_actions(name: str, *, is_compiled: bool = False) -> None:
    """Collect and learn where some actions are forbidden; assert that none of them is taken."""
    env = with_decisions(Forbidden(16), 1.0)
    specs = PAMDPSpecs.from_env(env)
    assert specs.has_action_mask and not specs.has_option_mask
    learner = make_learner(name, specs)
    if is_compiled:
        learner.compile_updates()
    play_and_learn(env, HierarchicalAgent(None, [learner], specs), 4)
    assert env.base_env.violations == 0
    parameters = [part for part in learner.state_dict().values() if torch.is_tensor(part) and part.is_floating_point()]
    assert not any(part.isnan().any() for part in parameters)


def inflate(learner, k: int) -> None:
    """Make action `k` look far better than all others, to everything that the learner bootstraps from."""
    networks = {
        "PDQN": ["critics", "target_critics"],
        "TD3BC": ["target_critics"],
        "HSAC": ["target_critics"],
        "PADDPG": ["target_actor"],
    }
    for network in networks.get(type(learner).__name__, []):
        part = getattr(learner, network)
        last = part.net[-1] if network == "target_actor" else part.net.layers[-1]
        last.bias.data[..., k] += 1000.0
    if hasattr(learner, "sarsa"):
        learner.policy.w[k] += 1000.0


@pytest.mark.parametrize("name", ["pdqn", "pdqn_n_step", "paddpg", "hsac", "td3_bc", "qpamdp"])
def test_what_a_forbidden_action_is_worth_does_not_change_a_value(name):
    learner = make_learner(name, PAMDPSpecs.from_env(Forbidden(2)))
    observation = torch.eye(NUM_DISCRETE)
    if name == "qpamdp":
        learner.warm_up(torch.rand(10, NUM_DISCRETE))
        learner.policy.w.normal_()
    mask = torch.arange(NUM_DISCRETE).expand(3, -1) != 1

    def value() -> torch.Tensor:
        torch.manual_seed(1)
        return learner.value(States(observation, mask), is_target=True)

    before = value()
    inflate(learner, 1)
    torch.testing.assert_close(value(), before)
    inflate(learner, 2)
    assert (value() - before).abs().max() > 1e-4


@pytest.mark.parametrize("name", ["hyar", "hyar_nearest"])
def test_a_latent_action_is_worth_what_its_allowed_action_is_worth(name):
    learner = make_learner(name, PAMDPSpecs.from_env(Forbidden(2)))
    observation = torch.eye(NUM_DISCRETE)

    def value(*allowed: int) -> torch.Tensor:
        torch.manual_seed(1)
        mask = torch.isin(torch.arange(NUM_DISCRETE), torch.tensor(allowed)).expand(3, -1)
        return learner.value(States(observation, mask))

    single = torch.stack([value(0), value(1), value(2)])
    assert (single - single[0]).abs().max() > 0.0
    pair = value(0, 2)
    if name == "hyar":
        torch.testing.assert_close(pair, single[[0, 2]].amax(0))
    embeddings = learner.codec.embeddings.detach()
    latent = torch.cat([embeddings, torch.zeros(3, learner.codec.latent_dim)], -1).unsqueeze(1)
    moved = learner.codec.of_allowed(latent, torch.tensor([False, True, False]).expand(3, -1))
    torch.testing.assert_close(moved[:, 0, : embeddings.shape[1]], embeddings[[1, 1, 1]])


@pytest.mark.parametrize("is_shared", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["per_option", "shared"])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in OF_EACH_KIND else pytest.mark.slow) for name in SHORT]
)
def test_an_option_that_is_a_set_of_actions_takes_no_other_action(name, is_shared):
    problem = Forbidden(8)
    problem.option_names = ()
    # Whatever is forbidden, each option allows something else.
    problem.group_actions({"low": [0, 1], "high": [1, 2], "ends": [0, 2]})
    env = with_decisions(problem, 1.0, 2)
    specs = PAMDPSpecs.from_env(env)
    assert specs.option_names == ("low", "high", "ends")
    parts = [specs.with_option_observed()] if is_shared else [specs.of_option(i) for i in range(3)]
    selector = make_config(["high=uniform", "low=random"]).high.build(specs=specs, device=CPU)
    agent = HierarchicalAgent(selector, [make_learner(name, each) for each in parts], specs, is_shared=is_shared)
    td = env.reset()
    for _ in range(4):
        with torch.no_grad():
            batch = env.rollout(8, agent.policy, break_when_any_done=False, auto_reset=False, tensordict=td)
        td = env.step_mdp(batch[:, -1])
        allowed = torch.tensor(specs.option_actions)[batch[keys.OPTION], batch[keys.DISCRETE]]
        assert allowed.all() and problem.violations == 0
        if name not in ("dlpa", "pets"):  # they have no value for the others to go on from
            agent.learn(batch)


SELECTORS = {
    **{high: [] for high in choices("high") if high not in ("auto", "none", "human", "oracle")},
    "fixed": ["high.option=first"],
    "meta_critic": ["high.warmup_decisions=32", "high.batch_size=16", "high.epsilon_decisions=50"],
    "option_critic": ["high.warmup_steps=64", "high.batch_size=16", "high.epsilon_steps=100"],
    "actor": ["high.minibatch_size=32"],
    "value": ["high.epsilon=0.2"],
}


@pytest.mark.parametrize("high", SELECTORS)
def test_a_forbidden_option_is_never_chosen(high):
    env = with_decisions(Forbidden(16, has_option=True), 1.0)
    specs = PAMDPSpecs.from_env(env)
    assert specs.has_option_mask
    torch.manual_seed(0)
    config = make_config([f"high={high}", "low=random", *SELECTORS[high]])
    selector: Selector = config.high.build(specs=specs, device=CPU)
    learner = make_learner("pdqn", specs) if selector.card.asks_learners else Random(specs)
    learners = [learner] * specs.num_options if selector.card.asks_learners else [learner]
    play_and_learn(env, HierarchicalAgent(selector, learners, specs), 5)
    assert env.base_env.violations == 0


class BestAction(Random):
    """Its value of a state is the highest number of an allowed action."""

    def value(self, states, *, is_target=False):
        allowed = self.specs.allowed(states.observation, states.action_mask)
        return torch.where(allowed, torch.arange(float(NUM_DISCRETE)), -torch.inf).amax(-1)


def test_what_learners_expect_of_an_option_counts_allowed_actions_alone():
    problem = Forbidden(3)
    problem.option_names = ()
    problem.group_actions({"low": [0, 1], "high": [1, 2], "ends": [0, 2]})
    specs = PAMDPSpecs.from_env(with_decisions(problem, 1.0, 2))
    values = OptionValues([BestAction(specs.of_option(i)) for i in range(3)], 3)
    action_mask = torch.tensor([[True, True, True], [True, True, False], [False, False, True]])
    expected = [[1.0, 2.0, 2.0], [1.0, 1.0, 0.0], [-torch.inf, 2.0, 2.0]]
    assert values(States(torch.zeros(3, NUM_DISCRETE), action_mask)).tolist() == expected


def grouped(problem: Forbidden, actions: dict[str, list[int]] | None = None) -> Forbidden:
    """Return the problem with sets of actions as options.

    By default forbidding an action forbids the option `last`, even while it is held.
    """
    problem.option_names = ()
    problem.group_actions(actions or {"low": [0, 1], "high": [1, 2], "last": [2]})
    return problem


@pytest.mark.parametrize("high", ["uniform", "meta_critic", "option_critic", "actor", "value"])
def test_an_option_ends_where_none_of_its_actions_is_allowed_any_more(high):
    problem = grouped(Forbidden(8))
    env = with_decisions(problem, 1.0, 3)
    specs = PAMDPSpecs.from_env(env)
    assert specs.has_option_mask
    torch.manual_seed(0)
    words = [f"high={high}", "low=random", *SELECTORS[high]]
    selector: Selector = make_config(words).high.build(specs=specs, device=CPU)
    learners = [make_learner("pdqn", specs.of_option(i)) for i in range(3)]
    play_and_learn(env, HierarchicalAgent(selector, learners, specs), 4)
    assert problem.violations == 0
    with torch.no_grad():
        batch = env.rollout(30, HierarchicalAgent(selector, learners, specs).policy, break_when_any_done=False)
    after = batch["next"]
    is_stuck = (batch[keys.OPTION] == 2) & ~after[keys.ACTION_MASK][..., 2] & ~after[keys.DONE].squeeze(-1)
    assert is_stuck.any()
    assert after[keys.OPTION_ENDED].squeeze(-1)[is_stuck].all()


class Revealing(Forbidden):
    """A mask that still forbids an action where the episode is over, terminated or truncated."""

    is_truncated = False

    def _read(self) -> TensorDict:
        is_forbidden = torch.nn.functional.one_hot(self.forbidden, NUM_DISCRETE) > 0
        after = super()._read().set(keys.ACTION_MASK, ~is_forbidden)
        if self.is_truncated:
            after[keys.TERMINATED], after[keys.TRUNCATED] = after[keys.TRUNCATED], after[keys.TERMINATED]
        return after


@pytest.mark.parametrize("name", ["hyar", "td3_bc"])
def test_an_episode_may_end_where_no_action_of_its_option_is_allowed(name):
    problem = grouped(Revealing(8))
    env = with_decisions(problem, 1.0, 3)
    specs = PAMDPSpecs.from_env(env)
    agent = HierarchicalAgent(Uniform(specs), [make_learner(name, specs.of_option(i)) for i in range(3)], specs)
    for learner in agent.learners:
        learner.frames.fill_(10_000)  # the warm-up is over
    with torch.no_grad():
        batch = env.rollout(24, agent.policy, break_when_any_done=False)
    after = batch["next"]
    has_action = (after[keys.ACTION_MASK].unsqueeze(-2) & torch.tensor(specs.option_actions)).any(-1)
    is_forbidden = batch["next", keys.OBSERVATION][..., 2] > 0.0
    is_stuck = (batch[keys.OPTION] == 2) & is_forbidden & after[keys.DONE].squeeze(-1)
    assert is_stuck.any() and has_action[is_stuck].all()
    assert not after[keys.ACTION_MASK][is_forbidden & ~after[keys.DONE].squeeze(-1)].all(-1).any()
    for learner, rows in zip(agent.learners, agent._views(batch), strict=True):
        learner.store(*rows[2:])
        assert learner.target(learner.augmented(learner.buffer[:])).isfinite().all()


class Closing(Revealing):
    """A mask that allows a single action where the episode is truncated."""

    max_steps = 1
    is_truncated = True

    def _read(self) -> TensorDict:
        after = super()._read()
        return after.set(keys.ACTION_MASK, after[keys.ACTION_MASK] ^ after[keys.DONE])


@pytest.mark.parametrize("option_length", [None, 3], ids=["lasts", "ends"])
def test_a_truncation_opens_the_actions_of_a_held_option_only_if_it_lasts_as_long_as_its_episode(option_length):
    problem = grouped(Closing(32))
    env = with_decisions(problem, 1.0, option_length)
    td = env.reset()
    option = torch.where(td[keys.OPTION_MASK][:, 2], 2, 0)
    own = torch.tensor(problem.option_actions)[option]
    discrete = (own & td[keys.ACTION_MASK]).int().argmax(-1)
    td.update({keys.OPTION: option, keys.DISCRETE: discrete, keys.PARAMETERS: torch.zeros(32, 3)})
    after = env.step(td)["next"]
    allowed = torch.nn.functional.one_hot(problem.forbidden, NUM_DISCRETE) > 0
    is_stuck = ~(allowed & own).any(-1)
    assert after[keys.TRUNCATED].all() and {*option[is_stuck].tolist()} == {0, 2}
    opened = own & is_stuck.unsqueeze(-1) if option_length is None else torch.zeros_like(own)
    assert after[keys.ACTION_MASK].equal(allowed | opened)
    assert after[keys.OPTION_MASK][:, 2].equal(allowed[:, 2]), "what may follow is not opened"
    if option_length is not None:
        assert after[keys.OPTION_ENDED].squeeze(-1).equal(is_stuck)


def test_a_truncated_option_without_an_action_is_followed_by_another_if_the_selector_ends_options():
    env = with_decisions(grouped(Closing(32)), 1.0, math.inf)
    specs = PAMDPSpecs.from_env(env)
    torch.manual_seed(0)
    selector: Selector = make_config(["high=meta_critic", "low=random"]).high.build(specs=specs, device=CPU)
    learners = [BestAction(specs.of_option(i)) for i in range(3)]
    agent = HierarchicalAgent(selector, learners, specs, selector_ends_options=True)
    with torch.no_grad():
        batch = env.rollout(6, agent.policy, break_when_any_done=False)
    batch = agent.next_options.with_next_option(agent.next_options.with_ends(batch))
    possible = batch["next", keys.OPTION_MASK]
    is_stuck = ~possible.gather(-1, batch[keys.OPTION].unsqueeze(-1)).squeeze(-1)
    assert is_stuck.any() and possible.gather(-1, batch[keys.NEXT_OPTION].unsqueeze(-1)).all()


@pytest.mark.parametrize("option_length", [None, 3])
@pytest.mark.parametrize("actions", [{"low": [0, 1], "last": [2]}, {"first": [0], "last": [2]}], ids=["one", "none"])
@pytest.mark.parametrize(("high", "low"), [("uniform", "hyar"), ("value", "hppo")])
def test_what_is_played_on_after_a_truncation_is_allowed(high, low, actions, option_length):
    env = with_decisions(grouped(Closing(32), actions), 1.0, option_length)
    specs = PAMDPSpecs.from_env(env)
    torch.manual_seed(0)
    selector: Selector = make_config([f"high={high}", "low=hppo", *SELECTORS[high]]).high.build(specs=specs, device=CPU)
    agent = HierarchicalAgent(selector, [make_learner(low, specs.of_option(i)) for i in range(2)], specs)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        after = env.step_mdp(env.step(agent.policy(env.reset())))
        played = agent.policy(after.clone())
    assert after[keys.TRUNCATED].all()
    option, discrete = played[keys.OPTION], played[keys.DISCRETE]
    assert torch.tensor(specs.option_actions)[option].gather(-1, discrete.unsqueeze(-1)).all()
    assert after[keys.ACTION_MASK].gather(-1, discrete.unsqueeze(-1)).all()
    assert after[keys.OPTION_MASK].gather(-1, option.unsqueeze(-1)).all()


def test_options_of_which_none_has_an_allowed_action_are_told_in_one_line():
    problem = Forbidden(20)
    problem.option_names = ()
    problem.group_actions({"only": [0]})
    expected = r"^environment \d+: no option has an action that its action_mask allows; give the options more actions$"
    with pytest.raises(ProblemError, match=expected):
        with_decisions(problem, 1.0, 3).reset()


def test_an_option_that_can_neither_go_on_nor_end_is_told_in_one_line():
    env = with_decisions(grouped(Forbidden(8)))
    held = torch.full((8,), 2)
    td = env.reset().update({keys.OPTION: held, keys.DISCRETE: held, keys.PARAMETERS: torch.zeros(8, 3)})
    expected = r"^environment \d: option 2 has no allowed action left, and .*; use agent.termination=steps"
    with pytest.raises(ProblemError, match=expected):
        env.step(td)


def test_a_mask_that_allows_nothing_is_told_in_one_line_that_names_the_environment():
    env = with_decisions(Forbidden(3, is_empty=True))
    with pytest.raises(ProblemError, match=r"^Forbidden: environment 0 gave an action_mask that allows nothing$"):
        env.reset()


def test_where_an_episode_is_over_a_mask_allows_everything():
    env = with_decisions(Forbidden(2))
    specs = PAMDPSpecs.from_env(env)
    rows = env.rollout(4, Random(specs).policy)
    assert rows["next", keys.ACTION_MASK][:, -1].all() and not rows["next", keys.ACTION_MASK][:, 0].all(-1).any()


def test_logits_of_any_size_leave_forbidden_choices_a_probability_of_zero():
    logits = torch.tensor([[-1e12, 0.0], [3.0, -1e20]])
    probability = masked_logits(logits, torch.tensor([[True, False], [False, True]])).softmax(-1)
    assert probability.tolist() == [[1.0, 0.0], [0.0, 1.0]]
