"""Memory: what policies remember, where it is reset, and how learners are trained on sequences of it."""

import itertools
import shutil
import signal

import pytest
import torch
from conftest import compose_config
from tensordict import TensorDict
from test_grid import SHORT
from test_resume import stop_and_resume, words_of
from toy_memory import Cue
from toy_options import Crossing, steppers

import hpamdp
from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner, Selector
from hpamdp.policies.high_level.actor import Actor
from hpamdp.policies.high_level.meta_critic import MetaCritic
from hpamdp.policies.high_level.option_critic import OptionCritic
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.hppo import HPPO
from hpamdp.policies.low_level.hsac import HSAC
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.policies.shared.sequences import HistoryLinks, ancestors, sample_with_past, sequence_starts, states_of_past
from hpamdp.run.train import run
from hpamdp.specs import PAMDPSpecs

SMALL = {"hidden_dims": [16, 16], "memory_size": 8}
LEARNERS = {"hppo": HPPO, "pdqn": PDQN, "hsac": HSAC}
# The state of a memory in a step.
STATES = {"stack": "stack_8", "gru": "gru_8"}


def make(low: str, specs: PAMDPSpecs, memory: str, **changes) -> Learner:
    more = {"critic_hidden_dims": [16, 16], "minibatch_size": 32} if low == "hppo" else {"batch_size": 16}
    return LEARNERS[low](specs, memory=memory, **{**SMALL, **more, **changes})


def played(low: str, memory: str, steps: int = 12, num_envs: int = 6, **changes) -> tuple[Learner, TensorDict]:
    """Return a learner and the steps of exploring episodes of Cue, `[num_envs, steps]`."""
    torch.manual_seed(0)
    env = with_decisions(Cue(num_envs))
    learner = make(low, PAMDPSpecs.from_env(env.base_env), memory, **changes)
    with torch.no_grad():
        return learner, env.rollout(steps, learner.policy, break_when_any_done=False)


@pytest.mark.parametrize("memory", ["stack", "gru"])
@pytest.mark.parametrize("low", LEARNERS)
def test_the_state_after_a_step_follows_from_the_observations_since_its_episode_began(low, memory):
    learner, rolled = played(low, memory)
    begins = rolled[keys.EPISODE_STEPS].squeeze(-1) == 0
    assert begins.sum() == 6 * 3
    state = None
    for t in range(rolled.shape[1]):
        # All episodes of Cue are equally long.
        state = learner.perception.after(rolled[keys.OBSERVATION][:, t], None if begins[0, t] else state)
        torch.testing.assert_close(rolled[STATES[memory]][:, t], state)


def test_a_stack_shows_the_last_observations_oldest_first_after_zeros():
    _, rolled = played("hppo", "stack", stack_steps=3)
    seen, shown = rolled[keys.OBSERVATION], rolled["stack_6"]
    assert torch.equal(shown[:, 3], seen[:, 1:4].flatten(1))
    assert torch.equal(shown[:, 4], torch.cat([torch.zeros(6, 4), seen[:, 4]], -1)), "another episode"


@pytest.mark.parametrize("is_shared", [False, True])
@pytest.mark.parametrize("low", LEARNERS)
def test_the_memory_of_one_option_begins_with_it_and_that_of_all_with_the_episode(low, is_shared):
    torch.manual_seed(0)
    env = Crossing(8, start=3.0)
    specs = PAMDPSpecs.from_env(env)
    own = [specs.with_option_observed()] if is_shared else [specs.of_option(i) for i in range(2)]
    learners = [make(low, each, "gru") for each in own]
    agent = HierarchicalAgent(Uniform(specs), learners, specs, is_shared=is_shared)
    with torch.no_grad():
        rolled = with_decisions(env, option_length=3).rollout(12, agent.policy, break_when_any_done=False)
    steps = rolled[keys.EPISODE_STEPS].squeeze(-1)
    begins = steps == 0 if is_shared else rolled[keys.IS_DECISION].squeeze(-1)
    assert begins.sum() < (steps % 3 == 0).sum() if is_shared else torch.equal(begins, steps % 3 == 0)
    for i, row in enumerate(rolled):
        state = None
        for t, step in enumerate(row):
            option = int(step[keys.OPTION])
            seen = step[keys.OBSERVATION]
            if is_shared:
                seen = torch.cat([seen, torch.eye(2)[option]])
            perception = learners[0 if is_shared else option].perception
            state = perception.after(seen, None if begins[i, t] else state)
            torch.testing.assert_close(step["gru_8"], state)


def everything(rolled: TensorDict) -> torch.Tensor:
    return torch.ones(rolled.shape, dtype=torch.bool)


# On-policy: H-PPO.


@pytest.mark.parametrize("length", [2, 3, 16])
def test_the_ratios_of_sequences_are_one_before_the_first_update(length):
    learner, rolled = played("hppo", "gru", steps=11, sequence_length=length)
    rows = learner.rows(rolled, everything(rolled))
    assert rows["starts"].sum() == 6 * {2: 6, 3: 5, 16: 3}[length]
    for minibatch in learner.minibatches(rows):
        _, scalars = learner.loss(minibatch, torch.tensor(1.0))
        assert scalars["discrete_kl"].abs() < 1e-9 and scalars["parameter_kl"].abs() < 1e-9


def test_sequences_start_where_histories_begin_or_go_on_and_are_never_longer_than_their_length():
    begins = torch.tensor([[1, 0, 0, 0, 0, 0, 1, 0], [0, 0, 0, 1, 0, 0, 0, 1]]).bool()
    mask = torch.tensor([[1, 1, 1, 1, 1, 1, 1, 1], [1, 1, 0, 0, 0, 1, 0, 1]]).bool()
    assert sequence_starts(begins, mask, 3).long().tolist() == [1, 0, 0, 1, 0, 0, 1, 0, 1, 0, 0, 1]


def test_minibatches_hand_over_whole_sequences_and_each_row_once_a_pass():
    learner, rolled = played("hppo", "gru", steps=20, epochs=2, sequence_length=3)
    rows = learner.rows(rolled, everything(rolled))
    rows["number"] = torch.arange(len(rows))
    sequence = rows["starts"].cumsum(0)
    seen = []
    for minibatch in learner.minibatches(rows):
        numbers = minibatch["number"]
        seen += numbers.tolist()
        of_sequences = sequence[numbers]
        for one in of_sequences.unique():
            assert torch.equal(numbers[of_sequences == one], (sequence == one).nonzero().squeeze(-1))
    assert sorted(seen) == sorted([*range(len(rows))] * 2)


def test_the_gradient_of_a_last_step_reaches_the_cue_through_time():
    learner, rolled = played("hppo", "gru", steps=4)
    rows = learner.rows(rolled, everything(rolled))
    gradient = {}
    for cue in (-1.0, 1.0):
        rows[keys.OBSERVATION].reshape(6, 4, 2)[:, 0, 0] = cue
        last = learner.critic(learner.features(rows)).reshape(6, 4)[:, -1].sum()
        gradient[cue] = torch.autograd.grad(last, learner.perception.memory.net.weight_ih_l0)[0]
    assert not torch.allclose(gradient[-1.0], gradient[1.0], atol=1e-6)
    # The weights of the cue, which is 0 in all steps but the first.
    assert gradient[1.0][:, 0].abs().max() > 0.0


# From a replay buffer: P-DQN and H-SAC.


def stored(low: str, num_batches: int, **changes) -> tuple[ReplayLearner, TensorDict]:
    """Return a learner that stored steps of Cue in batches of three steps, and all the steps."""
    learner, rolled = played(low, "gru", steps=3 * num_batches, warmup_steps=10_000, **changes)
    for batch in rolled.split(3, 1):
        learner.learn(batch, everything(batch))
    return learner, rolled


@pytest.mark.parametrize("buffer_size", [1000, 70])
def test_a_sequence_is_the_history_of_its_last_step_across_batches_and_never_of_another_environment(buffer_size):
    learner, rolled = stored("pdqn", 9, buffer_size=buffer_size, burn_in=1, sequence_length=2)
    sample = sample_with_past(learner.buffer, 500, learner.num_past)
    # The reward of a step and its observation after it tell nothing of the environment, but the stored state does.
    where = {tuple(row.tolist()): i for i, row in enumerate(rolled["gru_8"].flatten(0, 1))}
    lengths = set()
    for row in sample:
        env, step = divmod(where[tuple(row["memory"].tolist())], rolled.shape[1])
        since = int(rolled[keys.EPISODE_STEPS][env, step])
        num = int(row["num_past"])
        lengths.add(num)
        if buffer_size == 1000:
            assert num == min(since + 1, 3)
        expected = rolled[keys.OBSERVATION][env, step - num + 1 : step + 1]
        assert num <= since + 1 and torch.equal(row["past"][:num], expected)
        assert torch.equal(row["first_memory"], rolled["gru_8"][env, step - num + 1])
        assert bool(row["first_begins"]) == (num == since + 1)
    assert lengths == {1, 2, 3}


def test_a_buffer_counts_more_rows_than_32_bits_hold():
    learner, rolled = stored("pdqn", 2, buffer_size=70, burn_in=1, sequence_length=2)
    writer = learner.buffer._writer
    writer.load_state_dict({"_cursor": (2**31 - 20) % 70, "_write_count": 2**31 - 20})
    for batch in rolled.split(3, 1):
        learner.learn(batch, everything(batch))
    assert learner.buffer.write_count == 2**31 - 20 + rolled.numel()
    assert sample_with_past(learner.buffer, 100, learner.num_past)["num_past"].max() == 3


@pytest.mark.parametrize(("burn_in", "length"), [(0, 4), (2, 2), (3, 1), (0, 1), (0, 9)])
def test_sampled_states_are_those_of_the_policy_that_stored_them(burn_in, length):
    learner, _ = stored("hsac", 6, burn_in=burn_in, sequence_length=length)
    sample = sample_with_past(learner.buffer, 200, learner.num_past)
    for perception in (learner.perception, learner.target_perception):
        torch.testing.assert_close(learner.memory_of(sample, perception), sample["memory"])
    held = learner.last_memory(sample)
    torch.testing.assert_close(
        learner.target_perception(sample["next_state"], held)[:, :8],
        learner.perception.after(sample["next_state"], sample["memory"]),
    )


def test_gradients_flow_back_over_the_sequence_and_not_into_the_burn_in():
    learner, _ = stored("pdqn", 8, burn_in=2, sequence_length=2)
    sample = sample_with_past(learner.buffer, 100, learner.num_past)
    sample = sample[sample["num_past"] == 4][:1]
    sample.set("past", sample["past"].requires_grad_())
    gradient = torch.autograd.grad(learner.features(sample).sum(), sample["past"])[0][0].abs().sum(-1)
    assert (gradient[:2] == 0.0).all() and (gradient[2:] > 0.0).all()


@pytest.mark.parametrize("low", ["pdqn", "hsac"])
def test_only_the_critics_loss_trains_the_memory(low):
    learner, _ = stored(low, 8)
    before = {name: value.clone() for name, value in learner.perception.named_parameters()}
    target = {name: value.clone() for name, value in learner.target_perception.named_parameters()}
    sample = next(iter(learner.sample_batches(1)))
    learner.gradient_step("actor", learner.actor_loss, learner.detached(sample), None)
    assert all(torch.equal(value, before[name]) for name, value in learner.perception.named_parameters())
    learner.updates += 2
    learner.update_once(sample)
    assert not any(torch.equal(value, before[name]) for name, value in learner.perception.named_parameters())
    assert not any(torch.equal(value, target[name]) for name, value in learner.target_perception.named_parameters())


def test_histories_go_on_across_batches_and_not_into_a_buffer_that_was_given_up():
    links = HistoryLinks()
    never, always = torch.zeros(2, 2, dtype=torch.bool), torch.ones(2, 2, dtype=torch.bool)
    begun = torch.tensor([[True, False], [True, False]])
    assert links(begun, always, 0).tolist() == [[-1, 0], [-1, 2]]
    assert links(never, always, 4).tolist() == [[1, 4], [3, 6]]
    masked = torch.tensor([[True, True], [False, False]])
    assert links(never, masked, 8)[0].tolist() == [5, 8]
    assert links(never, always, 10).tolist() == [[9, 10], [7, 12]]
    assert links(never, always, 0).tolist() == [[-1, 0], [-1, 2]], "an empty buffer"
    assert links(never[:1], always[:1], 4).tolist() == [[-1, 4]], "another number of environments"


def test_overwritten_rows_are_no_ancestors():
    previous = torch.tensor([3, 4, 1, 2])  # of the rows 4, 5, 2 and 3 in a buffer of four
    places, num = ancestors(torch.tensor([5, 4, 3, 2]), previous, 6, 3)
    assert num.tolist() == [3, 3, 2, 1]
    assert places[0].tolist() == [3, 0, 1] and places[1].tolist() == [2, 3, 0] and places[2, :2].tolist() == [2, 3]


def test_n_step_returns_with_a_stack_go_on_with_the_state_after_their_last_step():
    learner, rolled = played("pdqn", "stack", n_step=3)
    rows = learner.transitions(rolled)
    assert torch.equal(rows["last_memory"][:, 0], rolled["stack_8"][:, 2])
    assert torch.equal(rows["last_memory"][:, 2], rolled["stack_8"][:, 3]), "the episode ends there"


# Options that end inside their episodes.


class Asked:
    """The `NextOptions` that keep the stored option, and the memories with which they were asked for values."""

    def __init__(self, *, decides_ends: bool) -> None:
        self.decides_ends = decides_ends
        self.memories: list[torch.Tensor] = []

    def choose(self, observation, option, held):
        return option

    def probabilities(self, observation):
        return None

    def value(self, states, option):
        self.memories.append(states.memory)
        return torch.zeros(len(option))


@pytest.mark.parametrize("is_shared", [False, True])
@pytest.mark.parametrize("decides_ends", [False, True])
def test_a_replayed_option_that_ends_is_followed_by_a_fresh_memory_unless_all_share_it(decides_ends, is_shared):
    torch.manual_seed(0)
    specs = PAMDPSpecs.from_env(Crossing(1))
    learner = make("pdqn", specs.with_option_observed() if is_shared else specs.of_option(0), "gru")
    learner.next_options = asked = Asked(decides_ends=decides_ends)
    num, dim = 3, learner.specs.observation_dim
    sample = TensorDict(
        {
            "state": torch.rand(num, dim), "next_state": torch.rand(num, dim), "past": torch.rand(num, 24, dim),
            "num_past": torch.tensor([1, 5, 24]), "first_memory": torch.rand(num, 8),
            "first_begins": torch.tensor([True, False, False]), "option_ended": torch.tensor([True, False, True]),
            "option": torch.zeros(num).long(), "next_option": torch.tensor([1, 0, 0]),
        },
        [num],
    )  # fmt: skip
    learner.next_value(sample)
    held = learner.last_memory(sample)
    expected = held if decides_ends else held[[0, 2]]
    if not is_shared:
        # A selector that decides on ends lets its option go on if it would choose it again.
        expected = expected * torch.tensor([0.0, 1.0, 1.0] if decides_ends else [0.0, 0.0]).unsqueeze(-1)
    torch.testing.assert_close(asked.memories[0], expected)


@pytest.mark.parametrize("is_shared", [False, True])
@pytest.mark.parametrize("decides_ends", [False, True])
def test_an_option_that_ends_is_followed_by_a_fresh_memory_in_the_trace_unless_all_share_it(decides_ends, is_shared):
    specs = PAMDPSpecs.from_env(Crossing(1))
    learner = make("hppo", specs.with_option_observed() if is_shared else specs.of_option(0), "gru")
    learner.next_options = asked = Asked(decides_ends=decides_ends)
    ended = torch.tensor([[[True], [False], [True]]])
    batch = TensorDict(
        {
            keys.OBSERVATION: torch.rand(1, 3, learner.specs.observation_dim), "gru_8": torch.rand(1, 3, 8),
            keys.OPTION: torch.zeros(1, 3).long(),
            "next": {
                keys.OBSERVATION: torch.rand(1, 3, learner.specs.observation_dim), keys.OPTION_ENDED: ended,
                keys.OPTION: torch.zeros(1, 3).long(), keys.REWARD: torch.zeros(1, 3, 1),
                keys.DONE: torch.zeros_like(ended), keys.TERMINATED: torch.zeros_like(ended),
            },
        },
        [1, 3],
    )  # fmt: skip
    learner.advantages(batch, everything(batch))
    assert torch.equal(asked.memories[0], batch["gru_8"][0])
    goes_on = torch.tensor([1.0, 1.0, 1.0] if is_shared else [0.0, 1.0, float(decides_ends)])
    torch.testing.assert_close(asked.memories[1], batch["gru_8"][0] * goes_on.unsqueeze(-1))


# Selectors.

SELECTORS = {"actor": Actor, "meta_critic": MetaCritic, "option_critic": OptionCritic}
LEARNS_NOTHING = {"actor": {"minibatch_size": 1000}, "meta_critic": {"warmup_decisions": 10_000}}


def decided(high: str, memory: str, num_batches: int = 4, **changes) -> tuple[Selector, list[TensorDict]]:
    """Return a selector that has learned from Crossing, and the steps in batches of six. Options last two steps."""
    torch.manual_seed(0)
    env = Crossing(8, start=3.0)
    env.max_steps = 9
    specs = PAMDPSpecs.from_env(env)
    size = {"memory_size": 8} if memory == "gru" else {"stack_steps": 3}
    selector = SELECTORS[high](specs, memory=memory, hidden_dims=[16], **size, **changes)
    agent = steppers(selector, specs)
    with torch.no_grad():
        rolled = with_decisions(env, option_length=2).rollout(
            6 * num_batches, agent.policy, break_when_any_done=False, auto_cast_to_device=False
        )
    batches = [batch.clone() for batch in rolled.split(6, 1)]
    for batch in batches:
        agent.learn(batch)
    return selector, batches


@pytest.mark.parametrize(
    ("high", "memory"), [*itertools.product(SELECTORS, ["stack"]), ("actor", "gru"), ("meta_critic", "gru")]
)
def test_a_selector_remembers_the_observations_at_the_decisions_of_an_episode(high, memory):
    selector, batches = decided(high, memory, **LEARNS_NOTHING.get(high, {}))
    rolled = torch.cat(batches, 1)
    num = 0
    for row in rolled:
        state = None
        for step in row:
            if step[keys.IS_DECISION]:
                before = None if step[keys.EPISODE_STEPS] == 0 else state
                state = selector.perception.after(step[keys.OBSERVATION], before)
                num += 1
            torch.testing.assert_close(step[selector.memory_key], state)
    assert num < rolled.numel() * 0.7


def test_the_sequences_of_a_selector_are_the_decisions_of_an_episode_across_batches():
    selector, batches = decided("meta_critic", "gru", burn_in=1, sequence_length=3, warmup_decisions=10_000)
    rolled = torch.cat(batches, 1)
    sample = sample_with_past(selector.buffer, 200, 4)
    where = {tuple(row.tolist()): i for i, row in enumerate(rolled[selector.memory_key].flatten(0, 1))}
    lengths = set()
    for row in sample:
        env, step = divmod(where[tuple(row["memory"].tolist())], rolled.shape[1])
        begin = step - int(rolled[keys.EPISODE_STEPS][env, step])
        is_decision = rolled[keys.IS_DECISION][env, begin : step + 1, 0]
        expected = rolled[keys.OBSERVATION][env, begin : step + 1][is_decision][-4:]
        num = int(row["num_past"])
        assert torch.equal(row["past"][:num], expected)
        lengths.add(num)
    assert lengths == {1, 2, 3, 4}
    torch.testing.assert_close(states_of_past(sample, selector.perception, 1), sample["memory"])


def test_the_ratios_of_an_actors_sequences_are_one_before_an_update():
    selector, _ = decided("actor", "gru", minibatch_size=1000, sequence_length=2)
    rows = torch.cat(selector.waiting)
    assert rows["starts"].sum() > rows["begins"].sum() > 0
    log_probs = selector.logits(selector.features(rows)).log_softmax(-1)
    now = log_probs.gather(-1, rows["option"].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(now, rows["log_prob"])


@pytest.mark.parametrize("high", [pytest.param("actor", marks=pytest.mark.slow), "meta_critic"])
def test_a_run_of_a_selector_with_a_recurrent_memory_resumes_to_the_last_bit(high, tmp_path):
    words = [
        *words_of(high, "random"), "env=rooms", "env.max_steps=12", "agent.termination=steps", "agent.option_length=2",
        "high.memory=gru", "high.memory_size=8",
    ]  # fmt: skip
    stop_and_resume(words, tmp_path, signal.SIGINT)


# In runs.


@pytest.mark.parametrize(
    "low", ["pdqn", *(pytest.param(low, marks=pytest.mark.slow) for low in ("hppo", "hsac", "dlpa"))]
)
def test_a_run_with_a_recurrent_memory_resumes_to_the_last_bit(low, tmp_path):
    words = [*words_of("ucb", low), "low.memory=gru", "low.memory_size=8", "low.sequence_length=3"]
    stop_and_resume(words, tmp_path, signal.SIGINT)


@pytest.mark.slow
@pytest.mark.parametrize("more", [["collector=multi"], ["agent.sharing=shared"], ["low.memory=stack"]])
@pytest.mark.parametrize("low", [*LEARNERS, "dlpa"])
def test_other_runs_with_a_memory_resume_to_the_last_bit(low, more, tmp_path):
    stop_and_resume([*words_of("ucb", low), "low.memory=gru", *more], tmp_path, signal.SIGTERM)


ENDING = list(itertools.product(LEARNERS, ["stack", "gru"], ["per_option", "shared"], ["steps", "learned"]))
QUICK = {("hppo", "gru", "per_option", "learned"), ("pdqn", "gru", "shared", "steps")}


@pytest.mark.parametrize(
    ("low", "memory", "sharing", "termination"),
    [pytest.param(*each, marks=() if each in QUICK else pytest.mark.slow) for each in ENDING],
)
def test_options_that_end_go_with_a_memory(low, memory, sharing, termination, tmp_path):
    words = [
        "env=crossing", "high=meta_critic", f"low={low}", f"low.memory={memory}", f"agent.sharing={sharing}",
        f"agent.termination={termination}", "high.warmup_decisions=8", "num_envs=8", "steps_per_batch=16",
        "total_frames=384", "eval.layouts=4", *SHORT.get(low, []),
    ]  # fmt: skip
    words += ["agent.option_length=4"] if termination == "steps" else []
    assert run(compose_config(words), tmp_path, words) == 0


def test_a_run_from_the_learners_of_another_has_links_of_its_own(tmp_path):
    words = [*words_of("ucb", "pdqn"), "low.memory=gru"]
    assert run(compose_config(words), tmp_path / "first", words) == 0
    words += [f"low.checkpoint={tmp_path / 'first'}", "num_envs=4"]
    assert run(compose_config(words), tmp_path / "second", words) == 0


@pytest.mark.parametrize("memory", ["stack", "gru"])
def test_an_agent_remembers_until_its_episode_ends(memory):
    settings = {"low.memory": memory, "total_frames": 256, "eval.every": 0, "eval.layouts": 4, "progress": False}
    agent = hpamdp.train(Cue, low="hppo", **settings)
    learner = agent._agent.learners[0]
    name = learner.memory_key
    observations = torch.tensor([[1.0, 0.0], [0.0, 0.25], [0.0, 0.5]])
    state = None
    for t, observation in enumerate(observations):
        agent.act(observation.numpy())
        state = learner.perception.after(observation, state)
        torch.testing.assert_close(agent._last[name][0], state), t
    agent.reset()
    agent.act(observations[0].numpy())
    torch.testing.assert_close(agent._last[name][0], learner.perception.after(observations[0]))
    with pytest.raises(ConfigError, match=f"export: HPPO cannot be exported: it remembers .*{name}"):
        agent.export("agent.onnx")


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("low", LEARNERS)
def test_updates_with_a_stack_can_be_compiled(low, tmp_path):
    words = [*words_of("ucb", low), "low.memory=stack", "compile_updates=true"]
    assert run(compose_config(words), tmp_path, words) == 0


# A problem that cannot be solved without memory: the best return is 1, the best one without memory 0 on average.


def score(low: str, memory: str, seed: int = 0, **settings) -> float:
    quiet = {"eval.every": 0, "eval.layouts": 4, "progress": False}
    agent = hpamdp.train(Cue, low=low, seed=seed, **{"low.memory": memory, **quiet, **settings})
    return agent.evaluate(episodes=500)["score"]


@pytest.mark.parametrize("memory", ["none", "stack"])
def test_a_stack_solves_what_cannot_be_solved_without_memory(memory):
    found = score("hppo", memory, total_frames=6144, num_envs=32, steps_per_batch=32)
    assert found >= 0.9 if memory == "stack" else abs(found) < 0.15
