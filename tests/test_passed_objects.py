"""Objects and classes that Python code passes reach worker processes, or are refused in one line."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

import hpamdp

TINY = {"total_frames": 1024, "num_envs": 8, "steps_per_batch": 64, "eval.layouts": 4, "progress": False}
OWN = {**TINY, "env.max_steps": 5, "low": "hppo"}
WORKERS = {"collector": "multi"}
PROCESSES = {"env.num_workers": 2}


def own_class() -> type[gymnasium.Env]:
    """Return a class that no other process can import."""

    class Reach(gymnasium.Env):
        observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        action_space = spaces.Tuple((spaces.Discrete(2), spaces.Tuple((spaces.Box(-1.0, 1.0, (1,)),) * 2)))

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return np.zeros(3, np.float32), {}

        def step(self, action):
            return np.zeros(3, np.float32), 1.0, False, False, {}

    return Reach


def with_lock(made: str) -> Callable[[], gymnasium.Env]:
    """Return a function, or an object that can be called, whose lock cannot be sent to another process."""
    cls, lock = own_class(), threading.Lock()
    if made == "function":
        return lambda: cls() if lock else None

    class Maker:
        def __init__(self):
            self.lock = lock

        def __call__(self):
            return cls()

    return Maker()


@pytest.mark.parametrize("processes", [WORKERS, PROCESSES], ids=["collector", "environment"])
@pytest.mark.parametrize("made", ["function", "object"])
def test_what_cannot_be_sent_to_processes_is_refused_in_one_line_and_nothing_is_written(made, processes, tmp_path):
    with pytest.raises(hpamdp.ConfigError, match=r"cannot be sent to .*cannot pickle '_thread.lock'") as raised:
        hpamdp.train(with_lock(made), folder=tmp_path / "run", **OWN, **processes)
    assert "\n" not in str(raised.value) and not (tmp_path / "run").exists()
    assert ("collector=single" if processes is WORKERS else "or use 0") in str(raised.value)


def test_a_learners_class_that_cannot_be_sent_is_refused_by_its_name():
    lock = threading.Lock()

    class Locked(hpamdp.HPPO):
        held = lock

    with pytest.raises(hpamdp.ConfigError, match="low=Locked: cannot be sent to the workers of collector=multi"):
        hpamdp.train("platform", low=Locked, **TINY, **WORKERS)


def test_what_cannot_be_sent_is_trained_in_one_process():
    assert hpamdp.train(with_lock("function"), **OWN).history[-1]["frames"] == 1024


@pytest.mark.slow
@pytest.mark.parametrize("processes", [WORKERS, PROCESSES], ids=["collector", "environment"])
@pytest.mark.parametrize("form", ["class", "function", "object"])
def test_a_problem_that_no_other_process_can_import_is_stepped_in_processes(form, processes):
    cls = own_class()
    env = {"class": cls, "function": lambda: cls(), "object": cls()}[form]
    assert hpamdp.train(env, **OWN, **processes).history[-1]["frames"] == 1024


@pytest.mark.slow
def test_a_learner_and_a_selector_that_no_other_process_can_import_act_in_workers():
    class OwnLearner(hpamdp.HPPO):
        pass

    class OwnSelector(hpamdp.UCB):
        pass

    agent = hpamdp.train("boatdock", low=OwnLearner, high=OwnSelector, **TINY, **WORKERS)
    assert "OwnSelector" in repr(agent) and agent.history[-1]["frames"] == 1024


@pytest.mark.slow
@pytest.mark.parametrize("processes", [WORKERS, PROCESSES], ids=["collector", "environment"])
def test_classes_of_a_program_that_a_notebook_runs_reach_processes(processes, tmp_path):
    # A cell's code has no file from which a worker could import `__main__`.
    code = f"""
import gymnasium, numpy as np, hpamdp
from gymnasium import spaces
class Cell(gymnasium.Env):
    observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = spaces.Tuple((spaces.Discrete(2), spaces.Tuple((spaces.Box(-1.0, 1.0, (1,)),) * 2)))
    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {{}}
    def step(self, action):
        return np.zeros(3, np.float32), 1.0, False, False, {{}}
print(hpamdp.train(Cell, **{OWN | processes}).history[-1]["frames"])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == ["1024.0"], done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("processes", [WORKERS, PROCESSES], ids=["collector", "environment"])
def test_an_id_that_only_this_program_registered_is_refused_in_one_line(processes):
    gymnasium.register(id="OnlyHere-v0", entry_point=own_class())
    try:
        with pytest.raises(hpamdp.ConfigError, match="name the module that registers it, as module:Name-v0") as raised:
            hpamdp.train("OnlyHere-v0", **OWN, **processes)
        assert "\n" not in str(raised.value)
    finally:
        del gymnasium.registry["OnlyHere-v0"]
