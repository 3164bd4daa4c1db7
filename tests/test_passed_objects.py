"""Objects and classes that Python code passes reach worker processes, or are refused in one line."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from hydra.core.config_store import ConfigStore

import hpamdp

TINY = {"total_frames": 512, "num_envs": 32, "steps_per_batch": 8, "eval.layouts": 4, "film": False, "progress": False}
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


def test_what_cannot_be_sent_is_trained_in_one_process():
    assert hpamdp.train(with_lock("function"), **OWN).history[-1]["frames"] == 512


@pytest.mark.slow
@pytest.mark.parametrize("processes", [WORKERS, PROCESSES], ids=["collector", "environment"])
@pytest.mark.parametrize("form", ["class", "function", "object"])
def test_a_problem_that_no_other_process_can_import_is_stepped_in_processes(form, processes):
    cls = own_class()
    env = {"class": cls, "function": lambda: cls(), "object": cls()}[form]
    assert hpamdp.train(env, **OWN, **processes).history[-1]["frames"] == 512


@pytest.mark.slow
def test_a_learner_and_a_selector_that_no_other_process_can_import_act_in_workers():
    class OwnLearner(hpamdp.HPPO):
        pass

    class OwnSelector(hpamdp.UCB):
        pass

    agent = hpamdp.train("boatdock", low=OwnLearner, high=OwnSelector, **TINY, **WORKERS)
    assert "OwnSelector" in repr(agent) and agent.history[-1]["frames"] == 512


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
    assert done.stdout.split() == ["512.0"], done.stderr


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


# Saved agents of passed classes.


class Softmax(hpamdp.UCB):
    """A selector that no yaml file names."""


class SizedOptions(hpamdp.HPPO.Options):
    """Settings of `Sized`, one of them without a default."""

    width: int


class Sized(hpamdp.HPPO):
    """A learner with a setting that has no default."""

    Options = SizedOptions


def forget(monkeypatch: pytest.MonkeyPatch, **classes: type) -> None:
    """Forget passed classes until the end of the test, as a new process has not seen them."""
    for group, cls in classes.items():
        monkeypatch.delitem(ConfigStore.instance().repo[group], f"{cls.__name__}.yaml")


@pytest.fixture(scope="module")
def of_classes(tmp_path_factory):
    """Return the folder of a run of a learner and a selector that were passed as classes."""
    folder = tmp_path_factory.mktemp("passed") / "run"
    hpamdp.train("boatdock", low={"name": Sized, "width": 3}, high=Softmax, folder=folder, **TINY)
    return folder


def test_an_agent_of_passed_classes_is_loaded_with_the_classes_in_a_new_process(of_classes, monkeypatch):
    forget(monkeypatch, low=Sized, high=Softmax)
    agent = hpamdp.load(of_classes, low=Sized, high=Softmax)
    assert "high=Softmax, low=Sized" in repr(agent)
    assert agent._config.low.settings["width"] == 3


def test_an_agent_of_passed_classes_is_loaded_without_them_in_the_same_process(of_classes):
    assert hpamdp.load(of_classes)._config.low.settings["width"] == 3


def of_module(module: str) -> type[hpamdp.HPPO]:
    """Return a learner's class as a module of this name would have it."""

    class Twin(hpamdp.HPPO):
        __module__ = module

    Twin.__qualname__ = "Twin"
    return Twin


def test_classes_of_one_name_from_two_modules_are_trained_and_loaded_in_one_process(tmp_path):
    classes = {name: of_module(name) for name in ("old", "new")}
    for name, cls in [*classes.items(), *classes.items()]:
        agent = hpamdp.train("platform", low=cls, folder=tmp_path / name, overwrite=True, **TINY)
        assert agent._config.low.cls is cls
    for name, cls in classes.items():
        assert hpamdp.load(tmp_path / name, low=cls)._config.low.cls is cls
        again = {"low": cls, "folder": tmp_path / name, "resume": "auto"}
        assert hpamdp.train("platform", **again, **TINY)._config.low.cls is cls
    for call in (partial(hpamdp.load, tmp_path / "old"), partial(hpamdp.train, resume=tmp_path / "old")):
        with pytest.raises(hpamdp.ConfigError, match=r"^low=Twin: several classes have this name; pass that of"):
            call()


def test_an_agent_of_a_forgotten_class_asks_for_the_class(of_classes, monkeypatch):
    forget(monkeypatch, high=Softmax)
    line = r"high/Softmax, which is not there; is a --config-dir missing\? Pass a class from Python again, as high$"
    with pytest.raises(hpamdp.ConfigError, match=line):
        hpamdp.load(of_classes)


@pytest.mark.parametrize(
    ("group", "value", "line"),
    [
        ("high", hpamdp.Exp3, "high=Exp3: the agent was trained with high=Softmax; pass that class, or leave it out"),
        ("low", "hppo", "low: a trained agent keeps it; pass its class alone, or leave it out"),
        ("low", {"name": Sized}, "low: a trained agent keeps it; pass its class alone"),
        ("exploration", int, "exploration=int: int is no Exploration (hpamdp.policies.exploration.base)"),
    ],
)
def test_another_choice_than_the_class_of_a_saved_agent_is_refused(of_classes, group, value, line):
    with pytest.raises(hpamdp.ConfigError) as raised:
        hpamdp.load(of_classes, **{group: value})
    assert line in str(raised.value) and "\n" not in str(raised.value)


def test_a_run_of_a_class_with_a_required_setting_is_resumed(of_classes, tmp_path, monkeypatch):
    forget(monkeypatch, low=Sized)
    more = {**TINY, "total_frames": 1024}
    agent = hpamdp.train(resume=of_classes, low=Sized, folder=tmp_path / "more", **more)
    assert agent._config.low.settings["width"] == 3
    assert agent.history[-1]["frames"] == 1024


def test_a_finished_run_of_passed_classes_comes_back_with_resume_auto(of_classes, monkeypatch):
    forget(monkeypatch, low=Sized, high=Softmax)
    given = {"low": {"name": Sized, "width": 3}, "high": Softmax, "folder": of_classes, "resume": "auto"}
    agent = hpamdp.train("boatdock", **given, **TINY)
    assert agent.history[-1]["frames"] == 512


def test_resume_auto_loads_no_finished_agent_of_another_config(tmp_path):
    """Somebody else may have put another checkpoint beside the config.yaml of the run."""
    given = {**TINY, "low": "hppo", "high": None}
    hpamdp.train("platform", folder=tmp_path / "run", **given)
    hpamdp.train(own_class(), folder=tmp_path / "other", **{**OWN, "high": None})
    for name in ("checkpoint.safetensors", "policy.safetensors"):
        (tmp_path / "other" / name).replace(tmp_path / "run" / name)
    line = 'has the results of another config, with env="gymnasium" for "platform"'
    with pytest.raises(hpamdp.ConfigError, match=line) as raised:
        hpamdp.train("platform", folder=tmp_path / "run", resume="auto", **given)
    assert "\n" not in str(raised.value)


def test_resume_auto_searches_no_folder_that_only_the_saved_run_names(tmp_path):
    own = tmp_path / "conf"
    (own / "high").mkdir(parents=True)
    given = {**TINY, "low": "random", "high": Softmax, "folder": tmp_path / "run"}
    hpamdp.train("boatdock", config_dirs=[own], **given)
    (own / "high" / "Softmax.yaml").write_text("_target_: nowhere.Another\n")
    assert hpamdp.train("boatdock", resume="auto", **given).history[-1]["frames"] == 512


def test_a_run_that_was_trained_on_an_object_asks_for_it_when_it_is_resumed(tmp_path):
    env = own_class()
    hpamdp.train(env, folder=tmp_path / "0", **OWN)
    line = r"^resume: .*: the agent was trained on an object from Python; pass it again as env$"
    with pytest.raises(hpamdp.ConfigError, match=line):
        hpamdp.train(resume=tmp_path / "0", total_frames=1024, progress=False)
    agent = hpamdp.train(env, resume=tmp_path / "0", total_frames=1024, progress=False)
    assert agent.history[-1]["frames"] == 1024
