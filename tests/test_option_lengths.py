"""With `agent.termination=chosen` the selector chooses an option and how many steps it lasts."""

from __future__ import annotations

import itertools
import math
import signal

import numpy as np
import pytest
import torch
from conftest import TRAINED, compose_config, make_config
from tensordict import TensorDict
from test_assemble import train
from test_decisions import check_accounts, collect
from test_grid import SHORT, SHORT_SELECTORS
from test_resume import SMALL as RESUMED
from test_resume import rows_without_times, stop_and_resume
from torchrl.data import Bounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_env import ToyEnv
from toy_options import Listener, Stepper, Toll

import hpamdp
from hpamdp import keys
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Selector
from hpamdp.policies.high_level.actor import ALLOWED, LOG_PROB, WEIGHT, Actor
from hpamdp.policies.high_level.meta_critic import MetaCritic
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.run.assemble import assemble
from hpamdp.run.evaluate import Evaluation
from hpamdp.run.train import run
from hpamdp.specs import PAMDPSpecs

CPU = torch.device("cpu")
LENGTHS = (1, 2, 4)
GAMMA = 0.9
CHOSEN = ["env=rooms", "env.max_steps=12", "agent.termination=chosen", "agent.option_lengths=[1,2,4]"]
SMALL = ["num_envs=16", "steps_per_batch=4", "total_frames=256", "eval.layouts=10", "eval.every=0", "log_every=64"]


def words_of(high: str, low: str, *words: str) -> list[str]:
    return [*CHOSEN, f"high={high}", f"low={low}", *SHORT.get(low, []), *SHORT_SELECTORS.get(high, []), *SMALL, *words]


def of_pairs(specs: PAMDPSpecs) -> PAMDPSpecs:
    return specs.with_option_lengths(LENGTHS)


def steppers(selector: Selector, specs: PAMDPSpecs) -> HierarchicalAgent:
    """Return an agent that takes whole steps with the selector's options and lengths."""
    return HierarchicalAgent(selector, [Stepper(specs), Stepper(specs)], specs, option_lengths=LENGTHS)


@pytest.mark.parametrize("batch_steps", [1, 7])
def test_an_option_is_held_for_exactly_the_chosen_steps_unless_its_episode_ends(batch_steps):
    torch.manual_seed(0)
    env = with_decisions(Toll(4, start=6.0), GAMMA, "chosen")
    specs = PAMDPSpecs.from_env(env)
    agent = steppers(Uniform(of_pairs(specs)), specs)
    rows = torch.cat([batch.clone() for batch in collect(env, agent.policy, 4, 63, batch_steps)], 1)
    ended = [each for environment in rows for each in check_accounts(environment, GAMMA, "chosen")]
    whole = {steps for steps, is_before_episode in ended if is_before_episode}
    assert whole == {*LENGTHS} and sum(not is_before_episode for _, is_before_episode in ended) > 3


def test_the_selector_learns_from_pairs_whose_next_value_is_discounted_by_their_steps():
    torch.manual_seed(0)
    env = with_decisions(Toll(4, start=0.0), GAMMA, "chosen")
    specs = PAMDPSpecs.from_env(env)
    agent = steppers(Listener(of_pairs(specs), gamma=GAMMA), specs)
    scalars = []
    for batch in collect(env, agent.policy, 4, 60, 5):
        scalars.append((agent.learn(batch), batch[keys.OPTION_LENGTH][batch[keys.IS_DECISION].squeeze(-1)]))
        goes_on = ~batch["next", keys.IS_DECISION][:, -1].squeeze(-1)
        assert agent.selector.pending.sum() == goes_on.sum() and len(agent.selector.pending) == 6
        option, length = (batch[name][:, -1][goes_on].tolist() for name in (keys.OPTION, keys.OPTION_LENGTH))
        for number in (o * 3 + LENGTHS.index(n) for o, n in zip(option, length, strict=True)):
            assert agent.selector.pending[number] > 0
    for learned, chosen in scalars:
        assert learned.get("high/length", math.nan) == pytest.approx(chosen.float().mean().item(), nan_ok=True)
    heard = torch.cat(agent.selector.heard)
    length = torch.tensor(LENGTHS)[heard[keys.OPTION] % 3]
    steps, done = (heard["next", name].squeeze(-1) for name in (keys.OPTION_STEPS, keys.DONE))
    assert torch.equal(length, heard[keys.OPTION_LENGTH]) and (length[~done] == steps[~done]).all()
    assert {*heard[keys.OPTION].tolist()} == {*range(6)}
    expected = torch.where(done, 0.0, GAMMA ** steps.float())
    torch.testing.assert_close(agent.selector.next_discount(heard), expected)


def test_learners_see_the_options_and_never_the_pairs():
    class Hearing(Stepper):
        def learn(self, batch, mask):
            assert batch[keys.OPTION].max() == 1 and batch[keys.NEXT_OPTION].max() <= 1
            assert torch.equal(mask, batch[keys.OPTION] == self.number)
            self.num_heard = getattr(self, "num_heard", 0) + int(mask.sum())
            return {}

    torch.manual_seed(0)
    env = with_decisions(Toll(4, start=0.0), GAMMA, "chosen")
    specs = PAMDPSpecs.from_env(env)
    learners = [Hearing(specs), Hearing(specs)]
    for number, learner in enumerate(learners):
        learner.number = number
    agent = HierarchicalAgent(MetaCritic(of_pairs(specs)), learners, specs, option_lengths=LENGTHS)
    for batch in collect(env, agent.policy, 4, 60, 5):
        agent.learn(batch)
    assert sum(learner.num_heard for learner in learners) == 240


@pytest.mark.parametrize("high", ["meta_critic", pytest.param("actor", marks=pytest.mark.slow)])
def test_lengths_that_leave_no_choice_give_the_run_of_options_of_that_length(high, tmp_path):
    words = words_of(high, "hppo", "agent.practice=128")
    fixed = [*words, "agent.termination=steps", "agent.option_lengths=null", "agent.option_length=3"]
    assert run(compose_config([*words, "agent.option_lengths=[3]"]), tmp_path / "chosen") == 0
    assert run(compose_config(fixed), tmp_path / "steps") == 0
    chosen, steps = rows_without_times(tmp_path / "chosen"), rows_without_times(tmp_path / "steps")
    for row in (*chosen, *steps):
        for name in [name for name in row if name.startswith("high/practice_")]:  # of pairs, and of options
            del row[name]
    lengths = [{name: row.pop(name) for name in ("eval/option_length", "high/length")} for row in chosen]
    assert chosen == steps
    assert {each["eval/option_length"] for each in lengths} == {"", "3.0"}


class Lights(ToyEnv):
    """Every `period` steps another option may become the right one, and only then the observation shows which.

    A step with the right option is rewarded with 1. The observation is dark, first or second, as a one-hot vector.
    """

    option_names = ("first", "second")
    parameter_dims = (1, 1)
    max_steps: int = 16

    def __init__(self, num_envs: int, period: int) -> None:
        super().__init__(device=CPU, batch_size=[num_envs])
        self.period = period
        self.begin(0.0, 1.0, 0, has_option=True, observation=Bounded(0.0, 1.0, shape=(num_envs, 3)))

    def _set_seed(self, seed):
        self.generator = torch.Generator().manual_seed(seed or 0)
        self.right, self.steps = torch.zeros(self.batch_size).long(), torch.zeros(self.batch_size).long()

    def _reset(self, tensordict=None):
        mask = self.reset_mask(tensordict)
        self.steps = torch.where(mask, 0, self.steps)
        return self._read()

    def _step(self, tensordict):
        reward = (tensordict[keys.OPTION] == self.right).float().unsqueeze(-1)
        self.steps = self.steps + 1
        return self._read().set(keys.REWARD, reward)

    def _read(self):
        is_lit = self.steps % self.period == 0
        fresh = torch.randint(2, self.batch_size, generator=self.generator)
        self.right = torch.where(is_lit, fresh, self.right)
        shown = torch.nn.functional.one_hot(torch.where(is_lit, 1 + self.right, 0), 3).float()
        done = (self.steps >= self.max_steps).unsqueeze(-1)
        return TensorDict({keys.OBSERVATION: shown, **self.flags(done)}, self.batch_size)


def make_meta_critic(specs: PAMDPSpecs) -> MetaCritic:
    return MetaCritic(
        specs, hidden_dims=[32], num_members=1, epsilon_final=0.2, epsilon_decisions=2000, gamma=GAMMA, batch_size=64,
        updates_per_decision=0.15, warmup_decisions=200, lr=3e-3, tau=0.05, buffer_size=5000,
    )  # fmt: skip


def make_actor(specs: PAMDPSpecs) -> Actor:
    # With little entropy it settles on long options while the values that follow short ones are still near 0.
    return Actor(specs, hidden_dims=[32], epochs=4, minibatch_size=128, entropy=0.05, lr=1e-2, gamma=GAMMA)


@pytest.mark.parametrize("period", [pytest.param(1, marks=pytest.mark.slow), 4])
@pytest.mark.parametrize(
    "make_selector", [make_meta_critic, pytest.param(make_actor, marks=pytest.mark.slow)], ids=["meta_critic", "actor"]
)
def test_the_selector_learns_to_hold_options_as_long_as_they_stay_right(make_selector, period):
    torch.manual_seed(0)
    env = with_decisions(Lights(50, period), GAMMA, "chosen")
    specs = PAMDPSpecs.from_env(env)
    agent = steppers(make_selector(of_pairs(specs)), specs)
    for batch in collect(env, agent.policy, 50, 480, 16):
        agent.learn(batch)
    shown = {keys.OBSERVATION: torch.eye(3)[1:], keys.IS_DECISION: torch.ones(2, 1, dtype=torch.bool)}
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        chosen = agent.policy[0](TensorDict(shown, [2]))
    assert chosen[keys.OPTION].tolist() == [0, 1]
    assert chosen[keys.OPTION_LENGTH].tolist() == [period, period]


# Options that a state forbids.


def masked(num: int) -> TensorDict:
    """Return `num` steps at which a decision is due, of which the odd ones forbid the first option."""
    mask = torch.ones(num, 2, dtype=torch.bool)
    mask[1::2, 0] = False
    is_due = torch.ones(num, 1, dtype=torch.bool)
    return TensorDict({keys.OBSERVATION: torch.rand(num, 3), keys.IS_DECISION: is_due, keys.OPTION_MASK: mask}, [num])


MASKED = PAMDPSpecs(3, ("first", "second"), (1, 1), (0.0, 0.0), (1.0, 1.0), has_option_mask=True)


@pytest.mark.parametrize("is_greedy", [False, True])
@pytest.mark.parametrize("kind", [MetaCritic, Actor, Uniform])
def test_a_forbidden_option_is_chosen_with_no_length(kind, is_greedy):
    torch.manual_seed(0)
    agent = steppers(kind(of_pairs(MASKED)), MASKED)
    exploration = ExplorationType.DETERMINISTIC if is_greedy else ExplorationType.RANDOM
    with set_exploration_type(exploration), torch.no_grad():
        td = agent.policy[0](masked(600))
    assert (td[keys.OPTION][1::2] == 1).all()
    assert td[keys.OPTION_MASK].shape == (600, 2), "the environment's own mask stays as it is"
    if not is_greedy:
        assert td[keys.OPTION][::2].float().mean() < 1.0
        assert {*td[keys.OPTION_LENGTH][1::2].tolist()} == {*LENGTHS}


def test_uniform_steps_are_uniform_over_allowed_pairs():
    torch.manual_seed(0)
    agent = steppers(Actor(of_pairs(MASKED)), MASKED)
    agent.selector.practice.fill_(1.0 / agent.selector.specs.num_options)
    td = agent.policy[0](masked(12_000))
    for rows, num in ((td[::2], 6), (td[1::2], 3)):
        pair = agent.pairs.with_pairs(rows)[keys.OPTION]
        shares = torch.bincount(pair, minlength=6)[-num:] / len(rows)
        torch.testing.assert_close(shares, torch.full((num,), 1.0 / num), atol=0.03, rtol=0.0)
        torch.testing.assert_close(rows[WEIGHT], rows[LOG_PROB].exp() * num)
        assert (rows[ALLOWED].sum(-1) == num).all()


GROUPED = [
    *("env=gymnasium", "env.entry_point=toy_masked_gymnasium:Masked", "env.action_mask=info", "env.max_steps=9"),
    "+env.grouping={first: [0], second: [1]}",
]


@pytest.mark.parametrize("sharing", ["per_option", "shared"])
def test_an_option_without_an_allowed_action_ends_before_its_length(sharing, tmp_path):
    # This problem forbids the action that was just taken.
    words = words_of("actor", "hppo", *GROUPED, "agent.option_lengths=[1,4]", f"agent.sharing={sharing}")
    parts = train(make_config(words), tmp_path / "run")
    rows = parts.env.rollout(30, parts.policy, break_when_any_done=False)
    assert (rows[keys.OPTION_LENGTH] == 4).any()
    assert (rows["next", keys.OPTION_STEPS] == 1).all() and rows[keys.IS_DECISION].all()


# Runs.

# The features of Q-PAMDP would be too many with the one-hot option at the end of the observation.
RUNS = [
    pair
    for pair in itertools.product(("meta_critic", "actor"), TRAINED, ("per_option", "shared"))
    if pair[1] != "planner" and pair[1:] != ("qpamdp", "shared")
]


@pytest.mark.slow
@pytest.mark.parametrize(("high", "low", "sharing"), RUNS)
def test_lengths_are_chosen_over_every_learner(high, low, sharing, tmp_path):
    given = words_of(high, low, f"agent.sharing={sharing}")
    assert run(compose_config(given), tmp_path, given) == 0
    rows = rows_without_times(tmp_path)
    assert 1.0 <= float(rows[-1]["eval/option_length"]) <= 4.0
    assert 1.0 <= float(rows[-1]["high/length"]) <= 4.0


@pytest.mark.parametrize(
    ("high", "low"), [("actor", "hppo"), pytest.param("meta_critic", "pdqn", marks=pytest.mark.slow)]
)
def test_a_run_that_chooses_lengths_resumes_to_the_last_bit(high, low, tmp_path):
    stop_and_resume([*words_of(high, low), *RESUMED], tmp_path, signal.SIGINT)


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [False, True])
def test_workers_choose_lengths_and_resume_to_the_last_bit(ahead, quick_workers, tmp_path):
    given = [*words_of("meta_critic", "hppo"), *RESUMED, "collector=multi", f"collector.ahead={str(ahead).lower()}"]
    stop_and_resume(given, tmp_path, signal.SIGTERM)


def test_an_agent_holds_options_for_the_chosen_steps_where_python_asks_step_by_step(tmp_path):
    settings = {"total_frames": 256, "num_envs": 16, "steps_per_batch": 4, "eval.layouts": 4, "env.max_steps": 12}
    hpamdp.train(
        "rooms", high={"name": "actor", "minibatch_size": 16}, low={"name": "hppo", "minibatch_size": 16},
        agent={"termination": "chosen", "option_lengths": [1, 2, 4]}, folder=tmp_path, progress=False, **settings,
    )  # fmt: skip
    agent = hpamdp.load(tmp_path)
    observations = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 3, 24)).astype(np.float32)
    lengths, options, due = [], [], []
    for observation in observations:
        agent.act(observation)
        lengths.append(agent._last[keys.OPTION_LENGTH].numpy())
        options.append(agent._last[keys.OPTION].numpy())
        due.append(agent._last[keys.IS_DECISION].squeeze(-1).numpy())
    lengths, options, due = np.stack(lengths), np.stack(options), np.stack(due)
    for column in range(3):
        left = 0
        for t in range(12):
            assert due[t, column] == (left == 0)
            if left:
                assert (lengths[t, column], options[t, column]) == (lengths[t - 1, column], options[t - 1, column])
            left = (left or lengths[t, column]) - 1
    assert 1.0 <= agent.evaluate(episodes=4)["option_length"] <= 4.0


def test_an_evaluation_measures_the_mean_length_of_the_options_that_were_chosen():
    class Alternating(Uniform):
        """Choose the first option for four steps at even places of the way, else for one step."""

        def select(self, td):
            return torch.where(td[keys.OBSERVATION].argmax(-1) % 2 == 0, 2, 0)

    env = with_decisions(Toll(2), 1.0, "chosen")
    specs = PAMDPSpecs.from_env(env)
    agent = steppers(Alternating(of_pairs(specs)), specs)
    evaluation = Evaluation(env, 0)
    # Decisions at the places 0, 3.25, 3.5, 4.5 and 5.5, of which 3.25 alone is odd; the episode ends at 6.
    played = evaluation.run(agent.policy)
    assert played["option_length"].tolist() == pytest.approx([3.4, 3.4])
    assert evaluation.measure(played)["option_length"] == pytest.approx(3.4)


def test_the_lengths_are_powers_of_two_by_default():
    words = ["env=rooms", "high=actor", "low=random", "agent.termination=chosen", "eval.layouts=4"]
    parts = assemble(make_config(words))
    assert parts.agent.option_lengths == tuple(2**i for i in range(8))
    assert parts.agent.selector.specs.num_options == 16
    assert parts.agent.selector.specs.option_names[8] == "boots_1"
