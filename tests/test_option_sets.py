"""Options that are sets of a problem's discrete actions: `env.grouping`."""

from __future__ import annotations

import pytest
import torch
from conftest import make_config
from test_assemble import QUICK_CRITIC, make, train
from test_grid import SHORT, SMALL

from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.config.saved import read_saved
from hpamdp.env.goal.environment import GoalEnv, HardGoalEnv
from hpamdp.env.hard_move.environment import HardMoveEnv
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.policies.random_agent import random_agent
from hpamdp.run import compatibility
from hpamdp.run.assemble import make_env
from hpamdp.specs import PAMDPSpecs

CPU = torch.device("cpu")


def options_of(*words: str) -> dict[str, list[int]]:
    """Return the numbers of each option's actions."""
    specs = PAMDPSpecs.from_env(make_env(make_config(["low=random", *words]), 2, CPU, 0))
    return {
        name: [number for number, is_allowed in enumerate(allowed) if is_allowed]
        for name, allowed in zip(specs.option_names, specs.option_actions, strict=True)
    }


@pytest.mark.parametrize(
    "actions", ["{carry: [0], shoot: [1, 2]}", "{carry: [kick_to], shoot: [shoot_left, 2]}", "default"]
)
def test_options_name_the_actions_of_a_problem_by_number_or_name(actions):
    assert options_of("env=goal", "high=uniform", f"+env.grouping={actions}") == {"carry": [0], "shoot": [1, 2]}


def test_problems_suggest_options():
    assert PlatformEnv().default_options == {"run": ["run"], "jump": ["hop", "leap"]}
    assert [len(actions) for actions in GoalEnv().default_options.values()] == [1, 2]
    assert [len(actions) for actions in HardGoalEnv().default_options.values()] == [1, 10]
    env = HardMoveEnv(n=6)
    quadrants = env.default_options
    assert sorted(number for actions in quadrants.values() for number in actions) == list(range(64))
    north_east = env.motions[quadrants["north_east"]]
    assert len(north_east) > 5 and (north_east >= 0).all()


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["env=goal", "+env.grouping={carry: [kick]}"], "env.grouping: GoalEnv has no discrete action kick; it has 0"),
        (["env=platform", "+env.grouping={run: [3]}"], "env.grouping: PlatformEnv has no discrete action 3; it has 0"),
        (["env=platform", "+env.grouping={run: []}"], "env.grouping: option run allows no action; name at least one"),
        (["env=platform", "+env.grouping={}"], "env.grouping: name at least one option"),
        (["env=rooms", "+env.grouping={up: [0]}"], "env.grouping: RoomsEnv has options of its own: skates, boots"),
        (["env=catch_point", "+env.grouping=default"], "env.grouping=default: env=catch_point suggests none"),
        (["env=hard_move", "low=planner", "+env.grouping=default"], "env.grouping: low=planner knows nothing of"),
        (["env=platform", "+env.grouping=3"], "env.grouping=3: must"),
    ],
)
def test_options_that_cannot_be_are_told_in_one_line(words, complaint):
    low = [] if any(word.startswith("low=") for word in words) else ["low=random"]
    with pytest.raises(ConfigError) as error:
        config = make_config(["high=uniform", *low, *words])
        compatibility.check(config)
        make_env(config, 2, CPU, 0)
    assert str(error.value).startswith(complaint) and "\n" not in str(error.value)


def test_an_action_that_the_option_does_not_allow_is_refused():
    env = PlatformEnv(2)
    env.group_actions(env.default_options)
    td = env.reset()
    td.update({keys.OPTION: torch.tensor([0, 1]), keys.ACTION: {"discrete": torch.tensor([0, 0])}})
    td[keys.PARAMETERS] = torch.ones(2, 3)
    with pytest.raises(
        ValueError, match=r"^step: environment 1 got option=1, discrete=0 \(the options allow run: \[0\], j"
    ):
        env.step(td)


def test_options_of_actions_are_saved_with_the_config():
    config = make_config(["env=platform", "high=uniform", "low=random", "+env.grouping={a: [0], b: [leap]}"])
    assert config.run.env.grouping == {"a": [0], "b": ["leap"]}
    assert read_saved(config.to_dict()) == config


@pytest.mark.parametrize("sharing", ["per_option", "shared"])
def test_a_problem_without_a_choice_trains_with_options_that_end_inside_episodes(sharing, tmp_path):
    words = [*SMALL, "env=platform", "+env.grouping=default", *QUICK_CRITIC, "low=pdqn", *SHORT["pdqn"]]
    ends = ["agent.termination=steps", "agent.option_length=2", f"agent.sharing={sharing}"]
    parts = train(make_config([*words, *ends]), tmp_path / "run")
    batch = parts.env.rollout(30, parts.policy, break_when_any_done=False)
    runs, jumps = batch[keys.OPTION] == 0, batch[keys.OPTION] == 1
    assert runs.any() and jumps.any()
    assert (batch[keys.DISCRETE][runs] == 0).all() and (batch[keys.DISCRETE][jumps] > 0).all()
    means = parts.evaluation.measure(parts.evaluation.run_agent(parts.agent))
    assert {"score_run", "score_jump"} <= set(means)


def test_a_selector_learns_over_frozen_learners_of_options_of_actions(tmp_path):
    words = [*SMALL, "env=platform", "+env.grouping=default", "high=ucb", "low=random", "low.freeze=true"]
    parts = train(make_config([*words, "total_frames=32"]), tmp_path / "run")
    assert parts.agent.selector.statistics.counts.sum() > 0


def test_the_random_agent_takes_the_actions_of_its_options(tmp_path):
    parts = make(make_config([*SMALL, "env=platform", "+env.grouping=default", "high=ucb", "low=random"]), tmp_path)
    batch = parts.env.rollout(20, random_agent(parts.agent.specs, CPU).policy, break_when_any_done=False)
    assert (batch[keys.DISCRETE][batch[keys.OPTION] == 0] == 0).all() and (batch[keys.DISCRETE] > 0).any()
