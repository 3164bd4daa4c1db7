"""A time limit is applied wherever an environment has one, and no environment ends the program unheard."""

from __future__ import annotations

import sys
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from conftest import compose_config
from gymnasium_players import step
from toy_environments import Toy

from hpamdp.config.errors import ConfigError
from hpamdp.env.gymnasium import copies
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.env.gymnasium.time_limit import limit_of
from hpamdp.env.registration import register
from hpamdp.run.train import run
from hpamdp.settings import SettingError

WORDS = ["env=gymnasium", "env.entry_point=test_gymnasium_limits:Leaving", "env.max_steps=3", "high=none", "low=random"]
WORDS += ["num_envs=2", "steps_per_batch=4", "total_frames=64", "eval.layouts=2"]


class Limited(Toy):
    """Says itself, in its spec, after how many steps it should end; no wrapper sees to it."""

    def __init__(self, limit: object = 4):
        super().__init__()
        self.spec = gymnasium.envs.registration.EnvSpec("Limited-v0", max_episode_steps=limit)


def wrapped(*limits: int) -> gymnasium.Env:
    env: gymnasium.Env = Limited()
    for limit in limits:
        env = gymnasium.wrappers.OrderEnforcing(gymnasium.wrappers.TimeLimit(env, limit))
    return env


@pytest.mark.parametrize("env_id", sorted(each for each in gymnasium.registry if each.startswith("hpamdp/")))
def test_each_problem_with_an_id_has_a_time_limit_as_a_gymnasium_environment(env_id):
    try:
        env = gymnasium.make(env_id)
    except SettingError as error:
        pytest.skip(str(error))
    limit = limit_of(env, None)
    assert limit is not None and limit > 4 and limit_of(env, 4) == 4


@pytest.mark.parametrize(
    ("env_id", "settings"),
    [
        ("hpamdp/PinballHard-v0", {"training_start": "anywhere"}),
        ("hpamdp/CircuitGHZ-v0", {"begin": "known"}),
        ("hpamdp/BoatDockUnseen-v0", {"fleet_size": 4}),
    ],
)
def test_problems_whose_training_begins_elsewhere_are_refused_as_gymnasium_environments(env_id, settings):
    with pytest.raises(SettingError, match="its training begins elsewhere than its evaluation, or in another world"):
        GymnasiumEnv(2, id=env_id, kwargs=settings)
    GymnasiumEnv(2, id=env_id).close()


class Leaving(Toy):
    """Calls `sys.exit` while it is built."""

    def __init__(self):
        sys.exit(0)


def episode_length(env: GymnasiumEnv) -> int:
    env.reset()
    flags = [step(env)["truncated"].item() for _ in range(env.max_steps)]
    assert flags.index(True) == len(flags) - 1
    return len(flags)


@pytest.mark.parametrize(
    ("options", "length"),
    [
        ({"entry_point": "Limited"}, 4),
        ({"entry_point": "Limited", "kwargs": {"limit": np.int64(3)}}, 3),
        ({"entry_point": "Limited", "max_steps": 6}, 6),
    ],
)
def test_the_limit_of_a_spec_is_applied_if_no_wrapper_does_so(options, length):
    options = {"max_steps": None, **options, "entry_point": f"{__name__}:{options['entry_point']}"}
    assert episode_length(GymnasiumEnv(observation_scaling="none", **options)) == length


@pytest.mark.parametrize(("limits", "given", "length"), [([3], None, 3), ([5, 2], None, 2), ([3], 3, 3), ([3], 2, 2)])
def test_the_lowest_of_several_limits_counts(limits, given, length, monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "made", lambda: wrapped(*limits), raising=False)
    assert episode_length(GymnasiumEnv(entry_point=f"{__name__}:made", max_steps=given)) == length


def test_a_limit_above_the_environments_own_is_refused(monkeypatch):
    monkeypatch.setattr(sys.modules[__name__], "made", lambda: wrapped(5, 3), raising=False)
    with pytest.raises(SettingError, match="max_steps=4: the environment ends its episodes after 3; give less or null"):
        GymnasiumEnv(entry_point=f"{__name__}:made", max_steps=4)
    register()
    with pytest.raises(SettingError, match="max_steps=601: the environment ends its episodes after 600; give"):
        GymnasiumEnv(id="hpamdp/PinballSimple-v0", max_steps=601)


@pytest.mark.parametrize("limit", [None, -1])
def test_without_a_limit_the_line_asks_for_one(limit):
    with pytest.raises(ValueError, match=r"has no time limit of its own; set env\.max_steps"):
        GymnasiumEnv(entry_point=f"{__name__}:Limited", kwargs={"limit": limit})


class Forbidding(Toy):
    """Ends its episodes after 8 steps without naming a limit, and forbids all discrete actions but one."""

    mask: ClassVar = [0, 1, 0]

    def __init__(self):
        super().__init__(length=8)

    def reset(self, **arguments):
        return super().reset(**arguments)[0], {"action_mask": self.mask}

    def step(self, action):
        assert action[0] == 1
        return *super().step(action)[:4], {"action_mask": self.mask}


def test_an_environment_that_ends_by_itself_needs_no_limit(monkeypatch, capsys):
    env = GymnasiumEnv(4, make=Forbidding, observation_scaling="none", staggered=True)
    env.reset()
    first = [step(env, torch.ones(4, dtype=torch.int64))["done"].squeeze(-1) for _ in range(8)]
    assert torch.stack(first).int().argmax(0).tolist() == [7, 4, 1, 6]  # apart by parts of eight steps
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith("names no time limit, so episodes are truncated after 10,000 steps; see env.max_steps")
    monkeypatch.setattr(copies, "_MOST_STEPS", 3)
    assert episode_length(GymnasiumEnv(make=lambda: Toy(length=8), observation_scaling="none")) == 3


def test_where_all_actions_are_forbidden_no_episode_is_tried(monkeypatch):
    monkeypatch.setattr(Forbidding, "mask", [0, 0, 0])
    with pytest.raises(SettingError, match=r"has no time limit of its own; set env\.max_steps"):
        GymnasiumEnv(make=Forbidding, observation_scaling="none")


def test_an_environment_that_ends_the_program_while_it_is_built_is_reported_in_one_line(tmp_path):
    told: list[str] = []
    assert run(compose_config(WORDS), tmp_path / "run", tell=told.append) == 1
    (line,) = told
    assert line.endswith("called sys.exit(0), which stopped the run") and ".py, line " in line and "\n" not in line


def test_a_reward_of_an_evaluation_that_is_not_finite_is_reported_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(Toy, "step", lambda self, action: (self._observation(), float("nan"), False, False, {}))
    words = [word for word in WORDS if "entry_point" not in word]
    line = "^env: GymnasiumEnv: .*: environment 0: step returned the reward nan, which is not finite in float32$"
    with pytest.raises(ConfigError, match=line):
        run(compose_config([*words, "env.entry_point=toy_environments:Toy"]), tmp_path)


def test_staggered_copies_end_their_first_episodes_apart_and_later_ones_at_the_limit():
    env = GymnasiumEnv(4, make=Limited, max_steps=8, staggered=True)
    ended = env.rollout(24, break_when_any_done=False)["next", "truncated"].squeeze(-1)
    assert [row.nonzero().squeeze(-1).tolist() for row in ended] == [[7, 15, 23], [4, 12, 20], [1, 9, 17], [6, 14, 22]]
    evaluated = env.rollout(8, auto_reset=False, tensordict=env.reset(env.fixed_episodes(0)))
    assert evaluated["next", "done"].squeeze(-1).sum(-1).tolist() == [1, 1, 1, 1] and evaluated.shape == (4, 8)


def test_episodes_terminate_at_a_limit_that_belongs_to_the_problem_but_not_where_copies_are_staggered():
    env = GymnasiumEnv(4, make=Limited, max_steps=8, staggered=True, terminates_at_limit=True)
    ended = env.rollout(24, break_when_any_done=False)["next", "terminated"].squeeze(-1)
    assert [row.nonzero().squeeze(-1).tolist() for row in ended] == [[7, 15, 23], [12, 20], [9, 17], [14, 22]]
