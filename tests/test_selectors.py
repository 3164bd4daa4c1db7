"""What all selectors have in common, the selectors that learn nothing, and the random agent."""

import inspect
import textwrap

import pytest
import torch
import yaml
from conftest import CONF, choices, make_config
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_bandits import CPU, SPECS, constant, due, play
from toy_options import Stepper, Toll

from hpamdp import keys
from hpamdp.config.components import load_class
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.reference import HUMAN_CONGRUENT_BY_OFFSET, OFFSET_EDGES
from hpamdp.env.decisions import with_decisions
from hpamdp.policies import base as policies_base
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Selector
from hpamdp.policies.high_level.actor import LOG_PROB, Actor
from hpamdp.policies.high_level.exp3 import PROBABILITY, Exp3
from hpamdp.policies.high_level.fixed import Fixed
from hpamdp.policies.high_level.human import Human
from hpamdp.policies.high_level.oracle import Oracle
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.random import Random
from hpamdp.policies.random_agent import random_agent
from hpamdp.run.assemble import assemble
from hpamdp.run.collection.single import SingleCollection
from hpamdp.settings import Fraction
from hpamdp.specs import PAMDPSpecs


def make_actor(specs: PAMDPSpecs) -> Actor:
    return Actor(specs, device=CPU, hidden_dims=[16], gamma=1.0, epochs=1, minibatch_size=8, lr=1e-3)


def make_exp3(specs: PAMDPSpecs) -> Exp3:
    return Exp3(specs, exploration=0.5, memory="all", discount=0.9, window=5)


class Counter(Selector):
    """Choose 0, 1, 0, 1, ... at successive calls, and write the number of the call."""

    def __init__(self) -> None:
        super().__init__(SPECS)
        self.out_keys = [*self.out_keys, "call"]
        self.calls = 0

    def select(self, td: TensorDict) -> torch.Tensor:
        self.calls += 1
        return torch.full(td.batch_size, (self.calls - 1) % 2)

    def held_with(self, td: TensorDict, option: torch.Tensor) -> dict[str, torch.Tensor]:
        return {"call": torch.full(td.batch_size, self.calls)}


def test_all_keys_of_a_choice_are_held_where_no_decision_is_due():
    counter, root = Counter(), due(4)
    first = counter(root)
    assert first[keys.OPTION].tolist() == [0] * 4 and first["call"].tolist() == [1] * 4
    root[keys.IS_DECISION] = torch.tensor([[True], [False], [False], [True]])
    second = counter(root)
    assert second[keys.OPTION].tolist() == [1, 0, 0, 1] and second["call"].tolist() == [2, 1, 1, 2]
    root[keys.IS_DECISION] = torch.zeros(4, 1, dtype=torch.bool)
    assert counter(root)["call"].tolist() == [2, 1, 1, 2] and counter.calls == 2


def probability_now(selector: Selector, rows: TensorDict) -> torch.Tensor:
    """Return the (log-)probability with which the selector would choose the rows' options now."""
    option = rows[keys.OPTION]
    if isinstance(selector, Exp3):
        return selector.probabilities.float()[option]
    return selector.logits(rows[keys.OBSERVATION]).log_softmax(-1).gather(-1, option.unsqueeze(-1)).squeeze(-1).detach()


@pytest.mark.parametrize(("env_class", "option_length"), [(BoatDockEnv, None), (Toll, None), (Toll, 4)])
@pytest.mark.parametrize(("make", "key"), [(make_actor, LOG_PROB), (make_exp3, PROBABILITY)])
def test_a_choices_probability_is_held_with_the_option_while_the_selector_learns(make, key, env_class, option_length):
    torch.manual_seed(0)
    env = with_decisions(env_class(6), option_length=option_length)
    specs = PAMDPSpecs.from_env(env)
    selector = make(specs)
    learner = Random if env_class is BoatDockEnv else Stepper
    agent = HierarchicalAgent(selector, [learner(specs), learner(specs)], specs)
    frames = dict(frames_per_batch=6 * 7, total_frames=6 * 63)
    collector = Collector(env, agent.policy, **frames, auto_register_policy_transforms=False)
    rows, now = [], []
    for batch in collector:
        rows.append(batch.clone())
        now.append(probability_now(selector, batch))
        agent.learn(batch)
    collector.shutdown()
    rows = torch.cat(rows, 1)
    now = torch.cat(now, 1)
    is_decision = rows[keys.IS_DECISION].squeeze(-1)
    torch.testing.assert_close(rows[key][is_decision], now[is_decision])
    goes_on = ~is_decision[:, 1:]
    assert goes_on.sum() > 50 and is_decision.sum() > 20
    for held in (keys.OPTION, key):
        assert torch.equal(rows[held][:, 1:][goes_on], rows[held][:, :-1][goes_on])
    assert not torch.isclose(rows[key], now).all(), "the selector has not learned while options were held"


class Keeper(Stepper):
    """Count the transitions of a data set."""

    def add_demonstrations(self, batch: TensorDict, mask: torch.Tensor) -> None:
        self.num_kept = mask.sum().item()


@pytest.mark.parametrize("make", [make_actor, make_exp3])
def test_a_selector_that_learns_from_its_own_choices_alone_leaves_a_data_set_to_the_learners(make):
    torch.manual_seed(0)
    env = with_decisions(Toll(4), option_length=3)
    specs = PAMDPSpecs.from_env(env)
    data_set = env.rollout(12, random_agent(specs, CPU).policy, break_when_any_done=False)
    selector = make(specs)
    before = {name: value.clone() for name, value in selector.named_parameters()}
    agent = HierarchicalAgent(selector, [Keeper(specs), Keeper(specs)], specs)
    agent.add_demonstrations(data_set)
    assert [learner.num_kept for learner in agent.learners] == torch.bincount(data_set[keys.OPTION].flatten()).tolist()
    assert all(torch.equal(value, before[name]) for name, value in selector.named_parameters())


@pytest.mark.parametrize("freeze", [False, True])
def test_pending_decisions_are_those_whose_end_the_selector_has_not_seen(freeze):
    words = ["high=ucb", "low=random", "num_envs=6", "steps_per_batch=7", "eval.layouts=4", f"low.freeze={freeze}"]
    config = make_config(words)
    parts = assemble(config)
    selector = parts.agent.selector
    collection = SingleCollection(config, parts)
    num_made = 0
    for _ in range(6):
        batch = collection.next()
        num_made += batch[keys.IS_DECISION].sum().item()
        assert selector.num_decisions + selector.pending.sum() == num_made  # as the selector itself counted them
        parts.agent.learn(batch)
        goes_on = ~batch["next", keys.IS_DECISION][:, -1].squeeze(-1)
        held = torch.bincount(batch[keys.OPTION][:, -1][goes_on], minlength=2)
        assert selector.pending.tolist() == held.tolist()
        assert selector.num_decisions + held.sum() == num_made
    collection.close()
    assert num_made > 12


def test_the_example_in_the_documentation_of_selectors_learns_the_better_option():
    docstring = inspect.cleandoc(Selector.__doc__)  # Python 3.13 keeps it without its indentation
    source = textwrap.dedent(docstring.partition("::\n")[2].partition("\nConstructor")[0])
    names = {**vars(policies_base), "Fraction": Fraction}
    exec(source, names)
    torch.manual_seed(0)
    options, _ = play(names["GreedyMean"](SPECS, epsilon=0.1), constant(0.0, 1.0), 600, noise=0.5)
    assert options[-200:].float().mean() > 0.8


@pytest.mark.parametrize(("option", "number"), [("left", 0), ("right", 1), (1, 1)])
def test_fixed_chooses_by_name_or_number(option, number):
    assert Fixed(SPECS, option=option).select(due(3)).tolist() == [number] * 3


@pytest.mark.parametrize("option", ["up", 2, -1])
def test_fixed_refuses_an_unknown_option_and_lists_the_known_ones(option):
    with pytest.raises(ValueError, match="left, right"):
        Fixed(SPECS, option=option)


def test_uniform_chooses_both_options_equally_often():
    torch.manual_seed(0)
    assert Uniform(SPECS).select(due(10_000)).float().mean().item() == pytest.approx(0.5, abs=0.02)


def test_oracle_chooses_what_the_environment_says():
    assert Oracle(SPECS).select(due(3, oracle={"option": torch.tensor([1, 0, 1])})).tolist() == [1, 0, 1]


@pytest.mark.parametrize("exploration", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
def test_human_chooses_the_congruent_boat_as_often_as_humans_do_at_each_bearing(exploration):
    torch.manual_seed(0)
    env = BoatDockEnv(20_000, human=True)
    human = Human(PAMDPSpecs.from_env(env))
    with set_exploration_type(exploration):
        chosen = human(with_decisions(env).reset())[keys.OPTION].float()
    way = env.state.goal_x - env.state.start_x, env.state.goal_y - env.state.start_y
    bearing = torch.rad2deg(torch.atan2(way[1], way[0]))
    # The congruent controller's keys point to 30, 150 and 270 degrees, y down.
    offset = torch.stack([((bearing - d + 180.0) % 360.0 - 180.0).abs() for d in (30.0, 150.0, 270.0)]).amin(0)
    for share, low, high in zip(HUMAN_CONGRUENT_BY_OFFSET, OFFSET_EDGES[:-1], OFFSET_EDGES[1:], strict=True):
        inside = (offset >= low) & (offset < high)
        assert inside.sum() > 2500
        assert chosen[inside].mean().item() == pytest.approx(share, abs=0.035)


# The random agent.


def test_the_random_agent_chooses_options_discrete_actions_and_parameters_uniformly():
    torch.manual_seed(0)
    td = random_agent(SPECS, CPU).policy(due(20_000))
    assert td[keys.OPTION].float().mean().item() == pytest.approx(0.5, abs=0.02)
    assert td[keys.DISCRETE].float().mean().item() == pytest.approx(0.5, abs=0.02)
    for parameter in td[keys.PARAMETERS].unbind(-1):
        assert parameter.min() >= 0.0 and parameter.max() <= 1.0
        assert torch.histc(parameter, 4, 0.0, 1.0).tolist() == pytest.approx([5000] * 4, rel=0.06)


def test_the_random_agent_has_no_selector_where_there_are_no_options():
    specs = PAMDPSpecs(2, (), (1, 2), (0.0,) * 3, (1.0,) * 3)
    agent = random_agent(specs, CPU)
    td = agent.policy(due(5))
    assert agent.selector is None and keys.OPTION not in td.keys() and td[keys.PARAMETERS].shape == (5, 3)


# The beginning of a run.


@pytest.mark.parametrize(
    "high",
    [
        pytest.param(high, marks=() if high in ("ucb", "meta_critic", "actor", "value") else pytest.mark.slow)
        for high in choices("high")
        if high not in ("none", "oracle", "human", "uniform")
    ],
)
def test_exploring_choices_are_uniform_for_the_first_steps_and_greedy_ones_never(high):
    low = "hppo" if high == "value" else "random"
    words = [f"high={high}", f"low={low}", "num_envs=400", "eval.layouts=4", "agent.practice=800"]
    words += ["high.warmup_decisions=0"] if high == "meta_critic" else []
    parts = assemble(make_config(words))
    torch.manual_seed(0)
    agent = parts.agent
    for _ in range(2):
        assert agent.selector.practice.tolist() == [0.5, 0.5]
        batch = parts.env.rollout(1, agent.policy)
        assert 0.4 < batch["option"].float().mean() < 0.6
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            td = parts.env.reset()
            assert (agent.selector(td.clone())["option"] == agent.selector.select(td)).all()
        agent.learn(batch)
    assert not agent.selector.practice.any()


@pytest.mark.parametrize("name", [name for name in choices("high") if name != "none"])
def test_a_selector_needs_no_settings_and_refuses_unknown_ones(name):
    cls = load_class(yaml.safe_load((CONF / "high" / f"{name}.yaml").read_text())["_target_"])
    assert cls(SPECS).specs is SPECS
    with pytest.raises((ValueError, TypeError), match="banana"):
        cls(SPECS, banana=1)
