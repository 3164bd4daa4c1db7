"""Sessions of trips: options last for trips, values look past them or not, and memories are kept over the session."""

import math
import signal

import pytest
import torch
from conftest import make_config
from tensordict import TensorDict
from test_resume import stop_and_resume, words_of
from torchrl.envs import check_env_specs
from torchrl.envs.utils import ExplorationType
from toy_options import Listener, steppers
from toy_trips import HiddenAction, HiddenOption, Sessions, SessionsOfOptions

import hpamdp
from hpamdp import keys
from hpamdp.acting import acting
from hpamdp.config.errors import ConfigError
from hpamdp.config.outside_jobs import choosing_class
from hpamdp.env.base import ProblemError
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent, with_option
from hpamdp.policies.base import Learner, Selector, States
from hpamdp.policies.high_level.actor import Actor
from hpamdp.policies.high_level.meta_critic import MetaCritic
from hpamdp.policies.high_level.option_critic import OptionCritic
from hpamdp.policies.high_level.thompson import Thompson
from hpamdp.policies.high_level.ucb import UCB
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.high_level.value import Value
from hpamdp.policies.low_level.dlpa.learner import DLPA
from hpamdp.policies.low_level.hppo import HPPO
from hpamdp.policies.low_level.hsac import HSAC
from hpamdp.policies.low_level.hyar import HyAR
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.policies.low_level.pets.learner import PETS
from hpamdp.policies.low_level.qpamdp import QPAMDP
from hpamdp.policies.low_level.random import Random
from hpamdp.policies.shared.sequences import sample_with_past, states_of_past
from hpamdp.policies.shared.session_bandit import SESSION_REWARDS, SessionRewards
from hpamdp.run.assemble import assemble
from hpamdp.specs import PAMDPSpecs

GAMMA = 0.5


# Options.


def test_specs_of_tracked_sessions_hold():
    check_env_specs(with_decisions(SessionsOfOptions(3)))
    check_env_specs(with_decisions(Sessions(3)))


@pytest.mark.parametrize("split", [1, 3, 12])
def test_a_selector_decides_once_a_trip_and_hears_each_trips_return(split):
    torch.manual_seed(0)
    env = with_decisions(SessionsOfOptions(4, trips=3), GAMMA)
    specs = PAMDPSpecs.from_env(env)
    selector = Listener(specs, gamma=GAMMA)
    agent = steppers(selector, specs)
    rolled = env.rollout(12, agent.policy, break_when_any_done=False)
    assert rolled[keys.IS_DECISION][0, :, 0].tolist() == [True, False] * 6
    assert rolled["next", keys.OPTION_ENDED][0, :, 0].tolist() == [False, True] * 6
    assert torch.equal(rolled[keys.OPTION][:, ::2], rolled[keys.OPTION][:, 1::2])
    assert len(rolled[keys.OPTION][:, ::2].unique(dim=1).T) > 1, "other options in other trips"
    for batch in rolled.split(split, 1):
        agent.learn(batch)
    heard = torch.cat(selector.heard)
    assert len(heard) == 4 * 6
    assert (heard["next", keys.OPTION_RETURN] == 1.0 + GAMMA).all()
    assert (heard["next", keys.OPTION_STEPS] == 2).all()
    at_decision = rolled[:, ::2].transpose(0, 1).flatten()[keys.OBSERVATION]
    assert torch.equal(heard["next", keys.DECISION_OBSERVATION], at_decision)
    is_last = torch.tensor([False, False, True] * 2).repeat_interleave(4)
    assert torch.equal(selector.next_discount(heard), torch.where(is_last, 0.0, GAMMA**2))


def test_options_of_a_fixed_length_end_with_their_trips_too():
    env = with_decisions(SessionsOfOptions(1, trips=2, length=3), option_length=2)
    rolled = env.rollout(6, steppers(Uniform(PAMDPSpecs.from_env(env)), PAMDPSpecs.from_env(env)).policy)
    assert rolled[keys.IS_DECISION][0, :, 0].tolist() == [True, False, True] * 2


def test_an_environment_with_trips_must_say_where_they_end():
    env = Sessions(1)
    del env.observation_spec[keys.TRIP_ENDED]
    with pytest.raises(ProblemError, match="Sessions: has_trips is true, but its observation_spec has no trip_ended"):
        with_decisions(env)


def test_without_a_choice_a_session_is_one_history():
    env = with_decisions(Sessions(1))
    rolled = env.rollout(8, Random(PAMDPSpecs.from_env(env)).policy, break_when_any_done=False)
    assert rolled[keys.IS_DECISION][0, :, 0].tolist() == [True, False, False, False] * 2
    assert rolled["next", keys.TRIP_ENDED][0, :, 0].tolist() == [False, True] * 4
    assert keys.OPTION_ENDED not in rolled["next"].keys()


# Values.

REPLAY = {"pdqn": (PDQN, {}), "hsac": (HSAC, {}), "hyar": (HyAR, {})}
PLANNING = {"pets": PETS, "dlpa": DLPA}
# Of the four steps of a session: the discount of what follows.
DISCOUNTS = {"session": [GAMMA, GAMMA, GAMMA, 0.0], "trip": [GAMMA, 0.0, GAMMA, 0.0]}
every_end = pytest.mark.parametrize("values_end", ["session", "trip"])


def agent_of(learners, specs: PAMDPSpecs, values_end: str, selector: Selector | None = None, **changes):
    agent = HierarchicalAgent(selector, learners, specs, **changes)
    agent.values_end_with_trips = agent.selector_values_end_with_trips = values_end == "trip"
    return agent


def played(env: Sessions, agent: HierarchicalAgent, steps: int = 4) -> TensorDict:
    with torch.no_grad():
        return with_decisions(env, GAMMA).rollout(steps, agent.policy, break_when_any_done=False)


@every_end
@pytest.mark.parametrize("low", REPLAY)
def test_stored_steps_are_followed_by_later_trips_only_if_values_last_a_session(low, values_end):
    env = Sessions(1)
    specs = PAMDPSpecs.from_env(env)
    cls, settings = REPLAY[low]
    learner = cls(specs, gamma=GAMMA, warmup_steps=1000, **settings)
    agent = agent_of([learner], specs, values_end)
    agent.learn(played(env, agent))
    assert learner.buffer[:]["discount"].tolist() == DISCOUNTS[values_end]


@every_end
@pytest.mark.parametrize("low", PLANNING)
def test_models_learn_that_plans_end_with_a_trip_whatever_values_look_past(low, values_end):
    env = Sessions(1)
    specs = PAMDPSpecs.from_env(env)
    learner = PLANNING[low](specs, gamma=GAMMA, warmup_steps=1000, end_values=True)
    agent = agent_of([learner], specs, values_end)
    agent.learn(played(env, agent))
    rows = learner.buffer[:]
    assert rows["discount"].tolist() == DISCOUNTS["trip"]
    assert rows["terminated"].tolist() == [False, True, False, True]
    if low == "dlpa":
        assert rows["successor"].tolist() == [1, -1, 3, -1]


@every_end
def test_n_step_returns_go_on_into_later_trips_only_if_values_last_a_session(values_end):
    env = Sessions(1)
    specs = PAMDPSpecs.from_env(env)
    learner = PDQN(specs, gamma=GAMMA, warmup_steps=1000, n_step=3)
    agent = agent_of([learner], specs, values_end)
    agent.learn(played(env, agent))
    expected = {"session": [1.75, 1.75, 1.5, 1.0], "trip": [1.5, 1.0, 1.5, 1.0]}
    assert learner.buffer[:]["reward"].tolist() == expected[values_end]
    assert learner.buffer[:]["discount"].tolist() == ([GAMMA**3, 0, 0, 0] if values_end == "session" else [0] * 4)


@every_end
def test_the_targets_of_q_pamdp_count_later_trips_only_if_values_last_a_session(values_end, monkeypatch):
    env = Sessions(1)
    specs = PAMDPSpecs.from_env(env)
    learner = QPAMDP(specs, warmup_steps=4)
    agent = agent_of([learner], specs, values_end)
    agent.learn(played(env, agent))
    seen = []
    monkeypatch.setattr(learner.sarsa, "update", lambda w, rows, *_: (seen.append(rows), (w, torch.zeros(())))[1])
    agent.learn(played(env, agent))
    ends = [each == 0.0 for each in DISCOUNTS[values_end]]
    assert seen[0]["terminated"][0].tolist() == seen[0]["done"][0].tolist() == ends


class Valuing(HPPO):
    """H-PPO whose every state has the value 10; it keeps its targets and learns nothing."""

    def value(self, states, *, is_target=False):
        return torch.full((len(states.observation),), 10.0)

    def learn(self, batch, mask):
        self.mask, self.targets = mask, self.advantages(batch, mask)[1]
        return {}


# By the values' end and the length of the batch. A batch of three steps ends inside the second trip.
TARGETS = {
    ("session", 4): [1.875, 1.75, 1.5, 1.0],
    ("trip", 4): [1.5, 1.0, 1.5, 1.0],
    ("session", 3): [3.0, 4.0, 6.0],
    ("trip", 3): [1.5, 1.0, 6.0],
}


@pytest.mark.parametrize(("values_end", "length"), TARGETS)
@pytest.mark.parametrize("sharing", ["no options", "per_option", "shared"])
def test_the_targets_of_hppo_count_later_trips_only_if_values_last_a_session(sharing, values_end, length):
    torch.manual_seed(0)
    env = Sessions(3) if sharing == "no options" else SessionsOfOptions(3)
    specs = PAMDPSpecs.from_env(env)
    is_shared = sharing == "shared"
    own = [specs.with_option_observed()] if is_shared else [specs.of_option(i) for i in range(specs.num_options)]
    learners = [Valuing(each, gamma=GAMMA, gae_lambda=1.0) for each in own or [specs]]
    selector = Uniform(specs) if specs.num_options else None
    agent = agent_of(learners, specs, values_end, selector, is_shared=is_shared)
    agent.learn(played(env, agent, length))
    targets = sum(learner.targets * learner.mask for learner in learners)
    torch.testing.assert_close(targets, torch.tensor(TARGETS[values_end, length]).expand(3, -1))


@every_end
@pytest.mark.parametrize("high", ["actor", "meta_critic", "option_critic"])
def test_selectors_count_later_trips_only_if_values_last_a_session(high, values_end):
    env = SessionsOfOptions(1)
    specs = PAMDPSpecs.from_env(env)
    settings = {"gamma": GAMMA, "hidden_dims": [8]}
    if high == "actor":
        selector = Actor(specs, minibatch_size=1000, **settings)
    else:
        selector = (MetaCritic if high == "meta_critic" else OptionCritic)(specs, **settings)
    agent = agent_of([Random(specs), Random(specs)], specs, values_end, selector)
    batch = played(env, agent)
    if high == "actor":
        selector.critic = torch.nn.Linear(3, 1)
        torch.nn.init.zeros_(selector.critic.weight)
        torch.nn.init.constant_(selector.critic.bias, 8.0)
    agent.learn(batch)
    follows = values_end == "session"
    if high == "actor":
        assert selector.waiting[0]["target"].tolist() == [1.5 + GAMMA**2 * 8.0 * follows, 1.5]
    elif high == "meta_critic":
        assert selector.buffer[:]["discount"].tolist() == [GAMMA**2 * follows, 0.0]
    else:
        assert selector.buffer[:]["discount"].tolist() == DISCOUNTS[values_end]


def test_the_selectors_values_may_last_a_session_while_the_learners_end_with_a_trip():
    env = SessionsOfOptions(1)
    specs = PAMDPSpecs.from_env(env)
    selector = MetaCritic(specs, gamma=GAMMA, hidden_dims=[8])
    learner = PDQN(specs.with_option_observed(), gamma=GAMMA, hidden_dims=[8], warmup_steps=1000)
    agent = agent_of([learner], specs, "trip", selector, is_shared=True)
    agent.selector_values_end_with_trips = False
    agent.learn(played(env, agent))
    assert selector.buffer[:]["discount"].tolist() == [GAMMA**2, 0.0]
    assert learner.buffer[:]["discount"].tolist() == DISCOUNTS["trip"]


def test_a_step_before_a_batch_ends_its_trip_for_a_selector_that_ends_options():
    torch.manual_seed(0)
    env = SessionsOfOptions(2, trips=4)
    specs = PAMDPSpecs.from_env(env)
    selector = MetaCritic(specs, gamma=GAMMA, hidden_dims=[8], warmup_decisions=1000)
    learners = [Random(specs), Random(specs)]
    agent = agent_of(learners, specs, "trip", selector, selector_ends_options=True)
    with torch.no_grad():
        rolled = with_decisions(env, GAMMA, float("inf")).rollout(12, agent.policy, break_when_any_done=False)
    for batch in rolled.split(2, 1):  # every batch ends with a trip
        agent.learn(batch)
    rows = selector.buffer[:]
    ended = rows["next_state"][:, 0] == 0.0
    assert ended.sum() >= 8
    assert (rows["discount"][ended] == 0.0).all() and (rows["discount"][~ended] > 0.0).all()


# Memories.

LEARNERS = {"hppo": (HPPO, {"minibatch_size": 1000}), "pdqn": (PDQN, {}), "hsac": (HSAC, {})}
GRU = {"memory": "gru", "memory_size": 8}


def remembering(low: str, values_end: str, *, is_shared: bool, **settings) -> tuple[Learner, TensorDict]:
    """Return a learner with a GRU, and two sessions of three environments that it has learned from."""
    torch.manual_seed(0)
    env = SessionsOfOptions(3) if is_shared else Sessions(3)
    specs = PAMDPSpecs.from_env(env)
    cls, own = LEARNERS[low]
    learner = cls(specs.with_option_observed() if is_shared else specs, **{**GRU, **own, **settings})
    agent = agent_of([learner], specs, values_end, Uniform(specs) if is_shared else None, is_shared=is_shared)
    rolled = played(env, agent, 8)
    agent.learn(rolled)
    return learner, with_option(rolled, 2) if is_shared else rolled


@every_end
@pytest.mark.parametrize("is_shared", [False, True])
@pytest.mark.parametrize("low", LEARNERS)
def test_the_memory_at_a_trips_first_step_goes_on_from_the_trip_before_until_the_session_ends(
    low, is_shared, values_end
):
    learner, rolled = remembering(low, values_end, is_shared=is_shared)
    state = None
    for t in range(8):
        state = learner.perception.after(rolled[keys.OBSERVATION][:, t], None if t == 4 else state)
        torch.testing.assert_close(rolled[learner.memory_key][:, t], state)


@every_end
@pytest.mark.parametrize("is_shared", [False, True])
def test_sequences_of_hppo_cross_the_ends_of_trips(is_shared, values_end):
    learner, rolled = remembering("hppo", values_end, is_shared=is_shared)
    rows = learner.waiting[0]
    assert rows["starts"].tolist() == [True, False, False, False] * 6
    torch.testing.assert_close(
        learner.features(rows),
        learner.perception(
            rolled[keys.OBSERVATION].flatten(0, 1), rolled[learner.memory_key].flatten(0, 1), has_seen=True
        ),
    )


@every_end
@pytest.mark.parametrize("is_shared", [False, True])
@pytest.mark.parametrize("low", ["pdqn", "hsac"])
def test_the_burn_in_of_replayed_steps_crosses_the_ends_of_trips(low, is_shared, values_end):
    learner, _ = remembering(low, values_end, is_shared=is_shared, burn_in=2, sequence_length=2, warmup_steps=1000)
    assert learner.buffer[:]["previous"].reshape(3, 8)[0].tolist() == [-1, 0, 1, 2, -1, 4, 5, 6]
    sample = sample_with_past(learner.buffer, 100, 4)
    assert set(sample["num_past"].tolist()) == {1, 2, 3, 4}
    torch.testing.assert_close(states_of_past(sample, learner.perception, 2), sample["memory"])


def test_with_a_learner_for_each_option_the_memory_begins_with_the_trip():
    torch.manual_seed(0)
    env = SessionsOfOptions(3)
    specs = PAMDPSpecs.from_env(env)
    learners = [HPPO(specs.of_option(i), **GRU) for i in range(2)]
    rolled = played(env, HierarchicalAgent(Uniform(specs), learners, specs))
    for step in rolled[:, 2]:
        own = learners[step[keys.OPTION]].perception
        torch.testing.assert_close(step["gru_8"], own.after(step[keys.OBSERVATION]))


@pytest.mark.parametrize("cls", [Actor, MetaCritic])
def test_a_selector_remembers_the_observations_at_the_decisions_of_a_sessions_trips(cls):
    torch.manual_seed(0)
    env = SessionsOfOptions(3, trips=3)
    specs = PAMDPSpecs.from_env(env)
    selector = cls(specs, hidden_dims=[8], **GRU)
    rolled = played(env, agent_of([Random(specs), Random(specs)], specs, "session", selector), 12)
    state = None
    for t in range(12):
        if t % 2 == 0:
            state = selector.perception.after(rolled[keys.OBSERVATION][:, t], None if t == 6 else state)
        torch.testing.assert_close(rolled[selector.memory_key][:, t], state)


# Bandits of a session.

BANDITS = {"ucb": UCB, "thompson": Thompson}
every_bandit = pytest.mark.parametrize("high", BANDITS)


def session_bandit(high: str, num_envs: int, steps: int, *, is_greedy: bool) -> tuple[Selector, TensorDict]:
    """Return a bandit of sessions, and steps of sessions of six trips that it has learned from."""
    torch.manual_seed(0)
    env = HiddenOption(num_envs, trips=6)
    specs = PAMDPSpecs.from_env(env)
    selector = BANDITS[high](specs, memory="session", exploration=0.5)
    agent = agent_of([Random(specs), Random(specs)], specs, "session", selector)
    with acting(ExplorationType.DETERMINISTIC if is_greedy else ExplorationType.RANDOM), torch.no_grad():
        rolled = with_decisions(env).rollout(steps, agent.policy, break_when_any_done=False)
    agent.learn(rolled)
    return selector, rolled


@every_bandit
def test_a_session_bandit_knows_the_returns_of_its_own_sessions_earlier_trips_alone(high):
    _, rolled = session_bandit(high, 5, 24, is_greedy=False)
    for row in rolled:
        for t, step in enumerate(row):
            begin = t // 12 * 12
            expected = torch.zeros(3, 2, dtype=torch.float64)
            for end in range(begin + 1, t // 2 * 2, 2):
                earned = row[end]["next", keys.OPTION_RETURN].item()
                expected[:, row[end][keys.OPTION]] += torch.tensor([1.0, earned, earned**2])
            assert torch.equal(step[SESSION_REWARDS], expected)


@pytest.mark.parametrize("is_greedy", [False, True])
@every_bandit
def test_a_session_bandit_finds_the_right_option_of_each_session_also_in_evaluation(high, is_greedy):
    selector, rolled = session_bandit(high, 40, 24, is_greedy=is_greedy)
    earned = rolled["next", keys.OPTION_RETURN][:, 1::2].reshape(40, 2, 6)
    assert {*earned[..., :2].flatten().tolist()} == {-2.0, 2.0}
    assert (earned[..., :2].sum(-1) == 0.0).all(), "both options are tried first"
    assert earned[..., 2:].mean() > 1.2
    assert not selector.statistics.counts.any() and selector.has_updated()


def test_the_bounds_of_a_session_equal_those_by_hand():
    selector = UCB(PAMDPSpecs.from_env(HiddenOption(1)), memory="session", exploration=0.5)
    # The first option earned 1 and 3, the second one 2.
    rewards = SessionRewards(torch.tensor([[[2.0, 1.0], [4.0, 2.0], [10.0, 4.0]]], dtype=torch.float64))
    deviation = math.sqrt(2.0 / 3.0)
    bounds = [2.0 + 0.5 * deviation * math.sqrt(2.0 * math.log(4.0) / count) for count in (2.0, 1.0)]
    assert selector.session_values(rewards)[0].tolist() == pytest.approx(bounds)


@pytest.mark.parametrize("high", ["ucb", pytest.param("thompson", marks=pytest.mark.slow)])
def test_a_run_with_a_session_bandit_resumes_to_the_last_bit(high, tmp_path):
    words = [*words_of(high, "random"), f"env={choosing_class('env', HiddenOption)}", "high.memory=session"]
    stop_and_resume(words, tmp_path, signal.SIGINT)


# Values of options.


@pytest.mark.parametrize("memory", ["gru", "stack"])
def test_options_are_compared_by_what_the_learner_remembers_of_the_session(memory):
    torch.manual_seed(0)
    env = SessionsOfOptions(6, trips=3)
    specs = PAMDPSpecs.from_env(env)
    learner = HPPO(specs.with_option_observed(), memory=memory)
    agent = agent_of([learner], specs, "session", Value(specs, epsilon=0.0), is_shared=True)
    rolled = played(env, agent, 12)
    agent.learn(rolled)
    rolled = played(env, agent, 12)
    held = rolled[learner.memory_key].roll(1, 1)
    held[:, [0, 6]] = 0.0  # sessions begin here
    values = []
    for option in range(2):
        seen = torch.cat([rolled[keys.OBSERVATION], torch.eye(2)[option].expand(6, 12, 2)], -1)
        values.append(learner.value(States(seen.flatten(0, 1), memory=held.flatten(0, 1))).reshape(6, 12))
    is_decision = rolled[keys.IS_DECISION].squeeze(-1)
    assert is_decision.sum() == 6 * 6
    assert torch.equal(rolled[keys.OPTION][is_decision], torch.stack(values, -1).argmax(-1)[is_decision])


@pytest.mark.parametrize("mode", [ExplorationType.DETERMINISTIC, ExplorationType.RANDOM])
def test_untried_options_of_a_session_come_first(mode):
    env = HiddenOption(5, trips=4)
    specs = PAMDPSpecs.from_env(env)
    selector = Value(specs, epsilon=0.0, untried_first=True)
    agent = agent_of([HPPO(specs) for _ in range(2)], specs, "session", selector)
    agent.selector.option_values.forward = lambda observation, *_: torch.tensor([1.0, 0.0]).expand(len(observation), 2)
    with acting(mode), torch.no_grad():
        rolled = with_decisions(env).rollout(16, agent.policy, break_when_any_done=False)
    assert rolled[keys.OPTION].tolist() == [[0, 0, 1, 1, 0, 0, 0, 0] * 2] * 5


def test_the_option_after_a_batch_is_chosen_with_what_session_and_learner_remember():
    torch.manual_seed(0)
    env = SessionsOfOptions(6, trips=3)
    specs = PAMDPSpecs.from_env(env)
    learner = HPPO(specs.with_option_observed(), memory="gru")
    selector = Value(specs, epsilon=0.0, untried_first=True)
    agent = agent_of([learner], specs, "session", selector, is_shared=True)
    rolled = played(env, agent, 12)
    for last in (1, 3):  # a trip has ended: its session's first, its second
        batch = rolled[:, : last + 1]
        assert torch.equal(
            agent.next_options.with_next_option(batch)[keys.NEXT_OPTION][:, -1], rolled[:, last + 1]["option"]
        )


# Settings.

QUIET = {"total_frames": 256, "num_envs": 8, "steps_per_batch": 16, "eval.every": 0, "eval.layouts": 4}
SMALL = {**QUIET, "progress": False, "low.minibatch_size": 64}


def test_an_agent_holds_its_option_until_it_is_told_that_the_trip_ended():
    more = {"high.memory": "gru", "agent.sharing": "shared", "low.memory": "gru"}
    agent = hpamdp.train(HiddenOption, low="hppo", high="actor", **SMALL, **more)
    agent._env.max_steps = 6  # it was trained in shorter sessions
    with acting(ExplorationType.DETERMINISTIC), torch.no_grad():
        rolled = with_decisions(HiddenOption(2, trips=3)).rollout(6, agent.policy)
    for step in rolled.unbind(1):
        agent.act(step[keys.OBSERVATION].numpy(), {"trip_ended": step[keys.TRIP_ENDED][:, 0].numpy()})
        for name in (keys.IS_DECISION, keys.OPTION, keys.OPTION_STEPS, *agent._kept):
            torch.testing.assert_close(agent._last[name], step[name])
    with pytest.raises(ValueError, match="give the info of the step with its trip_ended"):
        agent.act(step[keys.OBSERVATION].numpy())


def test_an_agent_that_chooses_by_the_rewards_of_a_session_does_not_act_without_them():
    agent = hpamdp.train(HiddenOption, low="hppo", high="ucb", **SMALL, **{"high.memory": "session"})
    assert agent.evaluate(episodes=4)["return"] == 0.0  # each option in one of two trips
    with pytest.raises(ValueError, match="act: high=ucb chooses by the rewards of earlier trips; use evaluate"):
        agent.act([0.0, 0.0, 0.0], {"trip_ended": False})
    with pytest.raises(ConfigError, match="export: UCB cannot be exported: it remembers session_rewards"):
        agent.export("agent.onnx")


@pytest.mark.parametrize(
    ("env", "settings", "message"),
    [
        ("platform", {"agent.values_end": "trip"}, "agent.values_end=trip: episodes of env=platform have no trips"),
        ("boatdock_unseen", {"agent.selector_values_end": "trip"}, "values_end=trip: high=none has no values; use"),
        (HiddenOption, {"high": "exp3", "high.memory": "session"}, "high.memory=.session.: must be"),
        (HiddenOption, {"compile_updates": True}, "compile_updates=true: env=HiddenOption has trips"),
        (
            HiddenOption,
            {"low.memory": "gru", "low.per_option": {"left": {"name": "hppo", "memory": "stack"}}},
            "low.per_option: env=HiddenOption has trips, and so needs the same memory",
        ),
        (HiddenOption, {"low.memory": "gru", "low.per_option": {"left": "pets"}}, "which value each other's states;"),
    ],
)
def test_what_does_not_go_with_trips_is_refused_in_one_line(env, settings, message):
    with pytest.raises(ConfigError, match=message) as error:
        hpamdp.train(env, low="hppo", **{**SMALL, **settings})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("words", "instead"),
    [
        ("low=hppo low.memory=gru", "agent.sharing=shared"),
        ("low=hppo low.memory=gru agent.sharing=shared", None),
        ("low=hppo", "low.memory=gru"),
        ("low=random", None),
    ],
)
def test_a_learner_that_forgets_earlier_trips_is_told_of_in_one_line(words, instead, capsys):
    assemble(make_config([f"env={choosing_class('env', HiddenOption)}", "eval.layouts=4", *words.split()]))
    warned = [line for line in capsys.readouterr().err.splitlines() if "forgets earlier trips" in line]
    assert len(warned) == (instead is not None) and all(instead in line for line in warned)


# What a session shows once is of use until its end. In its first step or trip, guessing earns 0 on average.

BUDGETS = {
    "hppo": {"total_frames": 16_384, "low.minibatch_size": 128},
    "pdqn": {"total_frames": 4000, "low.warmup_steps": 500, "low.epsilon_steps": 2000},
    "hsac": {"total_frames": 3000, "low.warmup_steps": 500},
    "dlpa": {"total_frames": 3000, "low.warmup_steps": 500, "low.horizon": 1, "low.batch_size": 64},
}
SCORED = {"eval.every": 0, "eval.layouts": 4, "progress": False, "num_envs": 16}


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "best"), [("gru", 3.0), ("stack", 3.0), ("none", 1.0)])
@pytest.mark.parametrize("low", BUDGETS)
def test_a_learner_uses_in_later_trips_what_an_earlier_one_has_shown(low, memory, best):
    settings = {**SCORED, "steps_per_batch": 32, **BUDGETS[low], "low.memory": memory}
    agent = hpamdp.train(HiddenAction, low=low, **settings)
    assert agent.evaluate(episodes=500)["return"] == pytest.approx(best, abs=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("high", "memory", "best"),
    [
        ("actor", "gru", 4.0),
        ("meta_critic", "gru", 4.0),
        ("actor", "none", 2.0),
        ("ucb", "session", 2.0),  # of three trips it needs two to try both options
        ("ucb", "discounted", 0.0),
    ],
)
def test_a_selector_with_a_memory_uses_in_later_trips_what_an_earlier_one_has_shown(high, memory, best):
    settings = {**SCORED, "steps_per_batch": 48, "total_frames": 12_288, "high.memory": memory}
    settings |= {"agent.values_end": "trip"}  # what to choose in a trip changes nothing for later ones
    agent = hpamdp.train({"name": HiddenOption, "trips": 3}, low="random", high=high, **settings)
    assert agent.evaluate(episodes=500)["return"] == pytest.approx(best, abs=0.4)
