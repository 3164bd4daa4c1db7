"""A fault in a third-party environment is told in one line, with the environment's own lines of the traceback alone."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import NormalizeObservation, NormalizeReward, TransformReward
from gymnasium_players import step
from toy_environments import Toy

import hpamdp
from hpamdp.env.errors import EnvironmentFaultError
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.env.gymnasium.observation_spaces import ObservationSpace


def play(entry_point: str, **kwargs) -> None:
    env = GymnasiumEnv(2, entry_point=entry_point, kwargs=kwargs, max_steps=3)
    env.reset()
    step(env)


@pytest.mark.parametrize("where", ["constructor", "reset", "step"])
def test_a_fault_is_told_in_one_line_that_says_whose_it_is_and_where(where):
    with pytest.raises(EnvironmentFaultError) as raised:
        play("toy_environments:Faulty", where=where)
    line, frames = str(raised.value), raised.value.frames
    copy = "" if where == "constructor" else "environment 0: "
    assert line.startswith(
        f"GymnasiumEnv: toy_environments:Faulty: {copy}its {where} raised ValueError: cannot reshape"
    )
    assert line.endswith(")") and "toy_environments.py, line " in line and "\n" not in line
    assert isinstance(raised.value.__cause__, ValueError)
    assert frames.count("File ") == 3 and frames.count("toy_environments.py") == 3
    assert frames.splitlines()[-1].strip().startswith(("np.zeros", "^", "~"))


def test_a_bug_of_the_package_itself_is_no_fault_of_an_environment(monkeypatch):
    monkeypatch.setattr(ObservationSpace, "quick", None)
    with pytest.raises(TypeError, match="not callable"):
        play("toy_environments:Toy")


def test_the_command_line_prints_the_line_and_the_environments_own_frames(command):
    words = ["env=gymnasium", "env.entry_point=toy_environments:Faulty", "env.max_steps=3", "env.kwargs={where:step}"]
    code, _, err = command("high=none", "low=random", "num_envs=2", "steps_per_batch=4", "total_frames=64", *words)
    err = err.replace(str(Path(__file__).parent), "")  # a clone may lie in a folder named hpamdp
    lines = [line for line in err.splitlines() if "steps" not in line]
    assert code == 1 and "its step raised ValueError" in err
    assert "Traceback" not in err and "hydra" not in err and "hpamdp/" not in err and len(lines) <= 12


class Unseeded(Toy):
    """Its generator ignores the seed of `reset`."""

    def reset(self, *, seed=None, options=None):
        return super().reset()


@pytest.mark.parametrize(("name", "changes"), [("observation_space", 2), ("action_space", 3)])
def test_a_space_that_depends_on_the_state_is_told_of_with_where_masks_and_bounds_go(name, changes):
    """The space changes with the last step, or in the second episode."""

    class Changing(Toy):
        def step(self, action):
            values = super().step(action)
            if len(self.actions) == changes:
                setattr(self, name, spaces.Box(0.0, 1.0, (9,)))
            return values

    line = (
        rf"environment \d: its {name} was .* and is now .*Box.*, but must stay the same; .*action_mask.*parameter_low"
    )
    with pytest.raises(hpamdp.ConfigError, match=line):
        hpamdp.train(Changing, low="hppo", high="none", max_steps=2, total_frames=512, num_envs=2, progress=False)


class Normalised(gymnasium.Wrapper):
    """Normalises rewards with statistics of its own, as wrappers of other libraries do."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.ret_rms = SimpleNamespace(mean=np.zeros(1), var=np.ones(1), count=1e-4)


@pytest.mark.parametrize("wrapper", [NormalizeReward, NormalizeObservation, Normalised])
def test_a_wrapper_with_running_statistics_is_refused_with_our_settings(wrapper):
    line = rf"{wrapper.__name__}: its running statistics .* env.observation_scaling=running .*, env.reward_scaling=0.99"
    with pytest.raises(hpamdp.ConfigError, match=line):
        hpamdp.make(lambda: TransformReward(wrapper(Toy()), float), max_steps=3)
    frozen = wrapper(Toy())
    frozen.update_running_mean = False
    hpamdp.make(lambda: frozen, max_steps=3).close()


def test_an_environment_that_ignores_its_seed_is_named_once(capsys):
    sizes = {"total_frames": 256, "num_envs": 2, "steps_per_batch": 32, "eval.layouts": 2, "env.max_steps": 3}
    hpamdp.train(Unseeded, low="hppo", high="none", progress=False, **sizes)
    assert capsys.readouterr().err.count("two resets with the same seed began differently") == 1
