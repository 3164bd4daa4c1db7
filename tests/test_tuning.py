"""Searches with Optuna: the space, the trials, pruning, and going on."""

from __future__ import annotations

import sys
from importlib.util import find_spec

import pytest
from conftest import choices, compose_config
from omegaconf import OmegaConf

import hpamdp
from hpamdp.api import tuning
from hpamdp.config.components import component
from hpamdp.config.search_space import Range, parsed_space, space_of_learner, split_words
from hpamdp.run.trainer import DivergedError

needs_optuna = pytest.mark.skipif(find_spec("optuna") is None, reason="needs hpamdp[tune]")


class Run:
    """Stands for a training of 400 steps with an evaluation every 100, whose score depends on `low.lr` alone."""

    def __init__(self, monkeypatch, *, stop_at: int | None = None, errors: dict[int, Exception] | None = None) -> None:
        self.given: list[dict] = []
        self.lengths: list[int] = []
        self.stop_at, self.errors = stop_at, errors or {}
        monkeypatch.setattr(tuning, "train", self)

    def __call__(self, env, *, callbacks, progress, **settings):
        (report,) = callbacks
        number = len(self.given)
        self.given.append({"env": env, **settings})
        self.frames, self.is_stopped, self.is_evaluation_due = 0, False, number == self.stop_at
        if number in self.errors:
            raise self.errors[number]
        while not self.is_over():
            report.on_evaluation(self, {"eval/score": -abs(settings["low.lr"] - 0.003) * 1000 + self.frames / 1000})
            self.frames += 100
            if self.is_evaluation_due:
                break
        if not self.is_stopped:
            report.on_evaluation(self, {"eval/score": -abs(settings["low.lr"] - 0.003) * 1000 + 1.0})
        self.lengths.append(self.frames)
        report.on_end(self)

    def is_over(self) -> bool:
        return self.is_stopped or self.frames >= 400

    def stop(self, reason: str) -> None:
        self.is_stopped = True


@pytest.mark.parametrize(
    "name", [low for low in choices("low") if low not in ("random", "planner") and not low.endswith("_published")]
)
def test_every_learner_has_a_space_of_allowed_values_around_its_defaults(name):
    space = parsed_space(space_of_learner(name, []))
    node = compose_config([f"low={name}"]).low
    assert len(space) >= 3
    for setting, each in space.items():
        values = [each.low, each.high] if isinstance(each, Range) else each
        own = setting.removeprefix("low.")
        default = OmegaConf.select(node, own, throw_on_missing=True)
        assert default in values or min(values) <= default <= max(values), setting
        for value in values:
            settings = OmegaConf.merge(node, {own: value})
            component("low", name, OmegaConf.to_container(settings, resolve=True))


def test_a_space_has_the_grammar_of_sweeps_or_lists():
    space = parsed_space(
        {
            "low.lr": "tag(log, interval(1e-4, 1e-2))",
            "low.epochs": "range(2, 10)",
            "low.clip": "interval(0.1, 0.3)",
            "low.minibatch_size": "512,1024",
            "low.memory": ["gru", None],
            "low.hidden": "interval(8, 64)",
        }
    )
    assert space == {
        "low.lr": Range(1e-4, 1e-2, is_log=True),
        "low.epochs": Range(2, 9),
        "low.clip": Range(0.1, 0.3),
        "low.minibatch_size": [512, 1024],
        "low.memory": ["gru", None],
        "low.hidden": Range(8, 64),
    }
    settings, searched = split_words(["env=platform", "low.lr=1e-4,1e-3", 'env.id="a b"', "x={a:[1,2]}", "high=null"])
    assert settings == {"env": "platform", "env.id": "a b", "x": {"a": [1, 2]}, "high": None}
    assert searched == {"low.lr": [1e-4, 1e-3]}


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"space": {"low.lr": "0.1"}}, r"^low.lr=0.1: one value; write interval\(LOW,HIGH\)"),
        ({"space": {"low.lr": "interval("}}, r"^low.lr=interval\(: not understood"),
        ({"space": {}}, "nothing to search"),
        ({"low": "hpo"}, r"low=hpo: no such search space; did you mean hppo\?"),
        ({"trials": 0}, "trials=0: must be a whole number of at least 1"),
        ({"callbacks": []}, "^callbacks: trials have none of their own; leave it out$"),
        ({"objective": "data", "data": "human"}, r"^objective=data: data.held_out must say which transitions judge"),
        ({"objective": "loss"}, "^objective=loss: must be 'score' or 'data'$"),
    ],
)
@needs_optuna
def test_a_wrong_argument_is_refused_in_one_line(given, line):
    with pytest.raises(hpamdp.ConfigError, match=line):
        hpamdp.tune("platform", **given)


@pytest.mark.parametrize("search", ["hppo", None])
def test_a_search_as_a_group_is_refused_with_the_command(search):
    with pytest.raises(hpamdp.ConfigError, match=r"^search=.*: a search is a command; write hpamdp tune low=LEARNER$"):
        hpamdp.train("platform", search=search)


def test_without_optuna_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(hpamdp.ConfigError, match=r"^Optuna is not installed; pip install 'hpamdp\[tune\]'$"):
        hpamdp.tune("platform", low="hppo")


SPACE = {"low.lr": "tag(log, interval(1e-4, 1e-1))"}


@needs_optuna
def test_the_best_settings_come_back_and_each_trial_has_a_seed_of_its_own(monkeypatch, capsys):
    errors = {3: DivergedError("low/critic is NaN"), 4: hpamdp.ConfigError("low.lr does not fit")}
    run = Run(monkeypatch, errors=errors)
    best = hpamdp.tune("platform", low="hppo", trials=12, space=SPACE, total_frames=400)
    assert [each["seed"] for each in run.given] == [1_000_000 + number for number in range(12)]
    assert {each["eval.seed"] for each in run.given} == {1_000_000}
    assert {each["total_frames"] for each in run.given} == {400}
    rates = [each["low.lr"] for number, each in enumerate(run.given) if number not in errors]
    assert best.settings["low.lr"] == min(rates, key=lambda rate: abs(rate - 0.003)) and best.trials == 12
    out = capsys.readouterr().out
    assert out.endswith(f"Best score {best.score:.3f} in 12 trials, with the settings\n{best.words}\n")
    assert "Trial 3: low/critic is NaN" in out and "Trial 4: low.lr does not fit" in out
    assert out.count("pruned") >= 1 and min(run.lengths) < 400 == max(run.lengths)


@needs_optuna
def test_a_search_in_a_folder_goes_on_and_refuses_another_one(monkeypatch, tmp_path, capsys):
    run = Run(monkeypatch, stop_at=2)
    first = hpamdp.tune("platform", trials=5, space=SPACE, folder=tmp_path / "tuned")
    assert len(run.given) == 3 and first.trials == 2 and "Stopped with 3 trials to go" in capsys.readouterr().out
    second = hpamdp.tune("platform", trials=5, space=SPACE, folder=tmp_path / "tuned", progress=False)
    assert len(run.given) == 6 and second.trials == 5 and second.score >= first.score
    assert len({each["low.lr"] for each in run.given}) == 6
    again = hpamdp.tune("platform", trials=5, space=SPACE, folder=tmp_path / "tuned", progress=False)
    assert again == second and len(run.given) == 6
    with pytest.raises(hpamdp.ConfigError, match="has another search; give a folder of its own"):
        hpamdp.tune("goal", trials=5, space=SPACE, folder=tmp_path / "tuned")


@needs_optuna
def test_held_out_people_choose_with_objective_data(monkeypatch):
    """Scores in the environment rise towards a rate of 0.003; what the data say of the agents falls with the rate."""
    run = Run(monkeypatch)

    def judge(folder, **data):
        assert folder == run.given[-1]["folder"] and data == {"data": "human", "data.held_out": [1, 2]}
        return [{"return": 1.0 - run.given[-1]["low.lr"]}]

    monkeypatch.setattr(tuning, "judge", judge)
    best = hpamdp.tune(
        "boatdock", trials=3, space={"low.lr": [1e-3, 3e-3, 1e-2]}, objective="data", low="iql",
        mode="offline", data="human", **{"data.held_out": [1, 2]},
    )  # fmt: skip
    tried = [each["low.lr"] for each in run.given]
    assert best.settings["low.lr"] == min(tried) and best.score == 1.0 - min(tried)


@needs_optuna
def test_settings_that_are_given_are_not_searched(monkeypatch):
    run = Run(monkeypatch)
    hpamdp.tune("platform", low={"name": "hppo", "epochs": 3}, trials=1, progress=False, **{"low.clip": 0.2})
    (given,) = run.given
    assert given["low"] == {"name": "hppo", "epochs": 3} and given["low.clip"] == 0.2
    assert "low.epochs" not in given and "low.minibatch_size" in given


@needs_optuna
def test_the_command_trains_and_prints_words_that_can_be_pasted(command, tmp_path):
    words = ["env=platform", "low=hppo", "low.lr=1e-3,1e-4", "total_frames=128", "num_envs=4", "steps_per_batch=32"]
    words += ["eval.layouts=4", "eval.every=64", "low.minibatch_size=16"]
    code, out, err = command("tune", *words, "--trials", "2", "--to", str(tmp_path / "tuned"))
    assert code == 0, err
    assert err == "" and out.splitlines()[-1] in ("low.lr=0.001", "low.lr=0.0001")
    assert (tmp_path / "tuned/trials.log").is_file()
    code, out, err = command("tune", *words, "low.epochs=-1", "--trials", "2")
    assert code == 2 and err.startswith("low.epochs=-1") and err.count("\n") == 1
