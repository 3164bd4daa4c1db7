"""Worker processes give what a single process gives, tell faults in one line, and end with the environment."""

from __future__ import annotations

import pytest
import torch
from conftest import make_config
from gymnasium_players import action, make, step

from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.env.base import ProblemError
from hpamdp.env.errors import EnvironmentFaultError
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.run.assemble import assemble


def masked(num_workers: int) -> GymnasiumEnv:
    return GymnasiumEnv(
        3,
        entry_point="toy_masked_gymnasium:Masked",
        kwargs={"form": "dict", "source": "observation"},
        max_steps=4,
        seed=5,
        num_workers=num_workers,
    )


def toys(num_workers: int) -> GymnasiumEnv:
    return make(3, max_steps=4, seed=5, kwargs={"length": 3, "success": True}, num_workers=num_workers)


@pytest.mark.parametrize("maker", [toys, pytest.param(masked, marks=pytest.mark.slow)])
def test_processes_give_the_same_steps_as_one_process(maker, quick_workers):
    one, other = maker(0), maker(2)
    generator = torch.Generator().manual_seed(0)
    try:
        for seen, same in ((one.reset(), other.reset()), (one.reset(), other.reset())):
            assert (seen == same).all()
        for number in range(9):
            discrete = torch.randint(2, (3,), generator=generator)
            parameters = torch.rand(3, sum(one.parameter_dims), generator=generator)
            td = action(one, discrete, parameters)
            if one.has_choice:
                td[keys.OPTION] = torch.randint(3, (3,), generator=generator)
                td[keys.DISCRETE] = torch.zeros(3, dtype=torch.int64)
            if number % 3 == 1:
                td["_step"] = torch.tensor([[True], [False], [True]])
            after, same = one.step(td.clone())["next"], other.step(td.clone())["next"]
            assert (after == same).all() and after.keys() == same.keys()
            if after["done"].any():
                assert (one.maybe_reset(after) == other.maybe_reset(same)).all()
    finally:
        other.close()


def test_processes_of_a_problem_are_refused_within_those_of_a_collector(quick_workers):
    words = ["env=gymnasium", "env.id=hpamdp/Moving-v0", "env.num_workers=2", "num_envs=4", "eval.layouts=4"]
    line = r"^collector=multi: env=gymnasium starts processes itself; use collector=single$"
    with pytest.raises(ConfigError, match=line):
        assemble(make_config([*words, "high=none", "low=hppo", "collector=multi"]))


def test_a_fault_in_a_worker_is_told_as_in_one_process(quick_workers, recwarn):
    env = faulty("step")
    env.reset()
    with pytest.raises(
        EnvironmentFaultError, match=r"Faulty: environment [02]: its step raised ValueError: .*line"
    ) as e:
        step(env)
    assert "in fail" in e.value.frames and "\n" not in str(e.value)
    assert not [warning for warning in recwarn if "Worker" in str(warning.message)]
    env.close()


def faulty(where: str) -> GymnasiumEnv:
    return GymnasiumEnv(3, entry_point="toy_environments:Faulty", kwargs={"where": where}, max_steps=3, num_workers=2)


@pytest.mark.slow
def test_a_worker_that_dies_is_told_in_one_line():
    env = GymnasiumEnv(2, entry_point="toy_environments:Killed", max_steps=3, num_workers=2)
    env.reset()
    step(env)
    with pytest.raises(ProblemError, match=r"Killed: worker [01] of 2 died \(signal 9, SIGKILL\)$"):
        step(env)
    env.close()
