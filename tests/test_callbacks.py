"""Callbacks stop training, keep the best agent and add metrics; a resumed run continues them."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import compose_config, make_config, parts_of, rows_of, signal_after
from hydra.core.hydra_config import HydraConfig
from test_folders import kill_at
from toy_callbacks import Faulty

from hpamdp.config.errors import ConfigError
from hpamdp.config.saved import read_saved
from hpamdp.config.schema import Config
from hpamdp.run import checkpoint
from hpamdp.run.callbacks import BestAgent, Callback, CallbackError, OwnMetrics, Patience, TimeLimit
from hpamdp.run.evaluate import Evaluation
from hpamdp.run.players import load_agent
from hpamdp.run.resume import rest_of
from hpamdp.run.train import begin, run
from hpamdp.run.trainer import Trainer

SIZES = ["num_envs=8", "steps_per_batch=4", "total_frames=320", "eval.layouts=4", "eval.every=32"]
SMALL = [*SIZES, "env=catch_point", "env.max_steps=5", "high=none", "low=random"]
PLATFORM = [*SIZES, "env=platform", "env.max_steps=20", "high=none", "low=hppo", "low.minibatch_size=8"]
PLATFORM += ["low.hidden_dims=[8]"]


def start(folder: Path, *words: str) -> int:
    return run(compose_config([*SMALL, *words]), folder, list(words))


def train(*callbacks: Callback, words: list[str] = SMALL, folder: Path | None = None) -> Trainer:
    trainer = begin(make_config(words), None, folder, callbacks=callbacks)
    trainer.shows_progress = False
    trainer.train()
    return trainer


def tensors_in(policy: Path) -> dict[str, torch.Tensor]:
    return {name: value for name, value in parts_of(policy)["agent"].items() if isinstance(value, torch.Tensor)}


@pytest.fixture(autouse=True)
def own_files(monkeypatch) -> None:
    """Have the job that is said to run search tests/conf, too."""
    monkeypatch.setattr(HydraConfig.instance(), "cfg", compose_config([]))


@pytest.fixture
def scores(monkeypatch) -> list[float]:
    """Scores of the evaluations of one run, which a test fills."""
    given: list[float] = []
    measure, numbers = Evaluation.measure, itertools.count()

    def of_the_list(*arguments):
        number = next(numbers) - 1  # the first are random actions
        return measure(*arguments) | ({"score": given[number]} if 0 <= number < len(given) else {})

    monkeypatch.setattr(Evaluation, "measure", of_the_list)
    return given


def test_patience_ends_a_run_after_evaluations_without_an_improvement_that_is_large_enough(scores):
    scores += [0.0, 1.0, 1.4, 1.5, 1.9, 1.9, 1.9, 9.0]
    trainer = train(Patience(3, min_improvement=0.5))
    assert (trainer.frames, trainer.last_score) == (192, 1.9)
    assert trainer.stop_reason == "3 evaluations without an improvement"


def test_a_time_limit_counts_the_time_before_a_resumption_and_is_followed_by_an_evaluation(tmp_path):
    assert start(tmp_path / "a", "eval.every=0", "total_frames=64") == 0
    wall_s = json.loads((tmp_path / "a/summary.json").read_text())["wall_s"]
    words = [
        f"resume={tmp_path / 'a'}",
        "total_frames=6400000",
        f"callbacks=[{{name:time_limit,minutes:{0.99 * wall_s / 60}}}]",
    ]
    assert run(compose_config(words), tmp_path / "b", words) == 0
    assert json.loads((tmp_path / "b/summary.json").read_text())["frames"] == 64
    words[-1] = f"callbacks=[{{name:time_limit,minutes:{(wall_s + 0.2) / 60}}}]"
    assert run(compose_config(words), tmp_path / "c", words) == 0
    last = rows_of(tmp_path / "c")[-1]
    assert 64 < float(last["frames"]) < 6400000 and last["eval/score"]
    assert wall_s + 0.2 <= float(last["wall_s"]) < wall_s + 30.0  # even on a busy machine


def test_a_run_ends_with_its_best_agent_which_can_be_scored_and_watched(scores, tmp_path, capsys):
    scores += [0.0, 3.0, 7.0, 2.0, 7.0, 1.0]
    words = [*PLATFORM, "total_frames=160", "save_best=true"]
    assert run(compose_config(words), tmp_path / "run", words) == 0
    best = checkpoint.progress_of(tmp_path / "run/best.safetensors")
    assert (best["frames"], best["last_score"]) == (64, 7.0)
    kept, at_end = (tensors_in(tmp_path / f"run/{name}.safetensors") for name in ("policy", "checkpoint"))
    assert not all(torch.equal(value, at_end[name]) for name, value in kept.items())
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert (summary["frames"], summary["kept_frames"]) == (160, 64) and summary["kept_score"] == 7.0 > summary["score"]
    assert (
        "clearly worse than the agent of 64 frames, whose score was 7.000: that one is kept" in capsys.readouterr().out
    )
    player = load_agent(str(tmp_path / "run"), [])
    assert player.progress["frames"] == 64
    assert all(torch.equal(value, player.agent.state_dict()[name]) for name, value in kept.items())
    words = ["mode=eval", f"checkpoint={tmp_path / 'run/best.safetensors'}"]
    assert run(compose_config(words), tmp_path / "eval", words) == 0
    assert json.loads((tmp_path / "eval/summary.json").read_text())["frames"] == 64


@pytest.mark.parametrize(("best_score", "is_better"), [(0.5, False), (0.51, False), (0.53, True), (None, False)])
def test_a_best_agent_is_clearly_better_beyond_two_standard_errors(best_score, is_better):
    best = BestAgent()
    best.best_score = best_score
    assert best.is_clearly_better(np.array([0.4, 0.6] * 100)) is is_better
    assert not best.is_clearly_better(np.array([0.4])), "one episode does not tell"


def test_the_best_agent_stays_in_memory_if_the_run_has_no_folder(scores):
    scores += [0.0, 3.0, 1.0, 2.0]
    best, weights = BestAgent(), []

    class Weights(Callback):
        def on_evaluation(self, trainer, row):
            weights.append([weight.clone() for weight in trainer.parts.agent.parameters()])

    trainer = train(best, Weights(), words=[*PLATFORM, "total_frames=96"])
    assert best.best_score == 3.0
    assert not all(map(torch.equal, trainer.parts.agent.parameters(), weights[1]))
    best.restore(trainer)
    assert all(map(torch.equal, trainer.parts.agent.parameters(), weights[1]))


def test_a_callback_may_be_used_for_another_run(scores):
    scores += [0.0, 9.0, 0.0, 0.0, *itertools.repeat(1.0, 3)]
    patience, best = Patience(evaluations=2), BestAgent()
    assert (train(patience, best).frames, best.best_score) == (96, 9.0)
    assert (train(patience, best, words=[*SMALL, "total_frames=32"]).frames, best.best_score) == (32, 1.0)


def test_metrics_of_ones_own_are_columns_of_every_row_and_part_of_the_summary(tmp_path):
    folder = tmp_path / "run"
    own = OwnMetrics(lambda trainer: {"frames": trainer.frames, "tensor": torch.tensor(2), "flag": True})
    trainer = train(own, words=[*SMALL, "log_every=32", "eval.every=64", "total_frames=128"], folder=folder)
    trainer.finish()
    rows = rows_of(folder)
    assert [(row["own/frames"], row["own/tensor"], row["own/flag"]) for row in rows] == [
        (row["frames"], "2.0", "1.0") for row in rows
    ]
    assert [row["frames"] for row in rows] == ["0.0", "32.0", "64.0", "96.0", "128.0"]
    assert json.loads((folder / "summary.json").read_text())["own/frames"] == 128.0


@pytest.mark.parametrize(
    ("returned", "complaint"),
    [
        ({"x": math.nan}, "OwnMetrics.metrics: x=nan: must be a finite number"),
        ({"a\rb": 1.0}, "the name must be a text in one line"),
    ],
)
def test_a_metric_without_a_number_or_a_name_is_told_in_one_line_after_training_was_saved(
    returned, complaint, tmp_path
):
    own = OwnMetrics(lambda trainer: returned if trainer.frames == 64 else {})
    with pytest.raises(CallbackError) as error:
        train(own, folder=tmp_path / "run")
    assert complaint in str(error.value)
    assert checkpoint.progress_of(tmp_path / "run/checkpoint.safetensors")["frames"] == 64


def test_two_metrics_of_one_name_are_refused():
    with pytest.raises(CallbackError, match=r"OwnMetrics_2.metrics: x=2: another callback has a metric of this name"):
        train(OwnMetrics(lambda trainer: {"x": 1}), OwnMetrics(lambda trainer: {"x": 2}))


@pytest.mark.parametrize("method", ["on_start", "on_batch", "on_end", "state"])
def test_an_error_in_a_callback_goes_through_after_training_was_saved(method, tmp_path):
    with pytest.raises(ZeroDivisionError) as error:
        train(Faulty(method, at=0 if method == "on_start" else 64), folder=tmp_path / "run")
    assert error.traceback[-1].path.name == "toy_callbacks.py"
    saved = checkpoint.progress_of(tmp_path / "run/checkpoint.safetensors")["frames"]
    assert saved == {"on_start": 0, "on_end": 320, "state": 320}.get(method, 64)


def test_a_wrong_metric_of_a_callback_from_yaml_ends_the_run_in_one_line_that_says_how_to_go_on(tmp_path, capsys):
    assert start(tmp_path / "run", "callbacks=[{name:recording,breaks_at:64}]") == 1
    err = capsys.readouterr().err
    told = err[err.rindex("Recording.metrics") :]
    assert told.startswith("Recording.metrics: seen=nan: must be a finite number at frame 64; to go on: ")
    assert f"resume={tmp_path / 'run'}" in told and "Traceback" not in err


@pytest.mark.parametrize(
    ("state", "complaint"),
    [
        ({"last": {1}}, "state/last is of type set, which a file cannot hold"),
        ({"of": torch.zeros(2, device="meta")}, "Cannot copy out of meta tensor"),
        ({"of": torch.eye(2).to_sparse()}, "Cannot access data pointer"),
        ({"of": torch.quantize_per_tensor(torch.ones(2), 0.1, 0, torch.qint8)}, "torch.qint8"),
    ],
)
def test_a_state_that_no_checkpoint_can_hold_is_refused_before_the_run_starts(state, complaint, tmp_path):
    class Stateful(Callback):
        def state(self):
            return state

    with pytest.raises(CallbackError) as error:
        train(Stateful(), folder=tmp_path / "run")
    assert f"Stateful.state: no checkpoint can hold it ({complaint}" in str(error.value)
    assert not (tmp_path / "run").exists()


class Unknown(Callback):
    """Has a state with a value that is not known yet."""

    def __init__(self) -> None:
        self.values: dict[str, Any] = {"last": math.nan, "all": torch.tensor([1, -7])}

    def on_batch(self, trainer) -> None:
        self.values["all"] = torch.tensor([-9, 3, 5])

    def state(self) -> dict[str, Any]:
        return self.values

    def set_state(self, state) -> None:
        self.values = {**state}


def test_a_state_may_hold_nan_for_what_is_not_known_yet(tmp_path):
    train(Unknown(), folder=tmp_path / "run")
    again = Unknown()
    source = tmp_path / "run" / "checkpoint.safetensors"
    begin(make_config([*SMALL, f"resume={source}"]), source, callbacks=[again]).parts.close()
    assert math.isnan(again.values["last"]) and again.values["all"].tolist() == [-9, 3, 5]


def test_a_callback_that_cannot_take_the_saved_state_is_named(tmp_path):
    class Other(Callback):
        def set_state(self, state):
            raise AttributeError("no shape")

    train(Unknown(), folder=tmp_path / "run")
    Other.__name__ = "Unknown"
    source = tmp_path / "run" / "checkpoint.safetensors"
    with pytest.raises(
        ConfigError, match=r"does not fit this run \(Unknown.set_state raised AttributeError: no shape\)"
    ):
        begin(make_config([*SMALL, f"resume={source}"]), source, callbacks=[Other()])


def test_callbacks_are_called_in_the_order_of_the_list_and_before_those_from_python(tmp_path):
    words = [*SMALL, "callbacks=[patience,{name:recording,breaks_at:0}]", "save_best=true"]
    trainer = begin(make_config(words), callbacks=[TimeLimit()])
    assert [*trainer.callbacks] == ["BestAgent", "Patience", "Recording", "TimeLimit"]
    words = [*SMALL, "callbacks=[time_limit,best_agent]", "save_best=true"]
    assert [*begin(make_config(words)).callbacks] == ["TimeLimit", "BestAgent"]


LIST = "callbacks=[time_limit,{name:patience,evaluations:5},{name:recording,breaks_at:${total_frames}}]"


def test_a_saved_config_holds_the_list_in_full_and_is_read_again():
    config = make_config([*SMALL, LIST])
    assert config.to_dict()["callbacks"] == [
        {"name": "time_limit", "minutes": 60.0},
        {"name": "patience", "evaluations": 5, "min_improvement": 0.0},
        {"name": "recording", "breaks_at": 320},
    ]
    assert read_saved(config.to_dict()) == config


def saved_with(callbacks: object) -> dict:
    return make_config(SMALL).to_dict() | {"callbacks": callbacks}


@pytest.mark.parametrize(
    ("callbacks", "complaint"),
    [
        ([{"name": "patience", "_target_": "os.PathLike"}], "callbacks.0._target_: a yaml file names the class"),
        (["../low/random"], 'callbacks.0="../low/random": must be the name of a callback, or its name and settings'),
        ([{"name": "recording", "breaks_at": "${oc.env:HOME}"}], "callbacks.0.breaks_at="),
    ],
)
def test_a_saved_config_chooses_no_class_but_those_of_todays_yaml_files(callbacks, complaint):
    with pytest.raises(ConfigError) as error:
        read_saved(saved_with(callbacks))
    assert str(error.value).startswith(complaint) and "\n" not in str(error.value)


def test_a_guarded_setting_of_a_callback_in_a_saved_config_needs_trust():
    saved = saved_with([{"name": "guarded", "command": "ls"}])
    with pytest.raises(ConfigError, match=r"^callbacks=.*set by the saved run, and can run code"):
        read_saved(saved)
    assert read_saved(saved, trust=True).callbacks[0].settings == {"command": "ls"}


def test_help_explains_the_settings_of_listed_callbacks(command):
    code, out, _ = command("callbacks=[{name:patience,evaluations:7},best_agent]", "--help")
    assert code == 0
    assert "Settings of callback=patience\n  evaluations=7\n      Evaluations without" in out
    assert "callback=best_agent has no settings" in out


STOPPED_AT = 5  # batches


def test_a_resumed_run_counts_on_and_knows_its_best_agent(tmp_path, monkeypatch):
    words = [*PLATFORM, "env.max_steps=200", "total_frames=960", "save_best=true"]
    words += ["callbacks=[{name:patience,evaluations:4},recording]"]
    assert run(compose_config(words), tmp_path / "whole", words) == 0
    with signal_after(STOPPED_AT):
        assert run(compose_config(words), tmp_path / "stopped", words) == 130
    resumed = tmp_path / "resumed"
    again = [f"resume={tmp_path / 'stopped'}"]
    assert run(compose_config(again), resumed, again) == 0
    whole = json.loads((tmp_path / "whole/summary.json").read_text())
    assert json.loads((resumed / "summary.json").read_text())["frames"] == whole["frames"] < 960
    columns = ("frames", "eval/score", "own/seen")
    assert [[row[name] for name in columns] for row in rows_of(resumed)] == [
        [row[name] for name in columns] for row in rows_of(tmp_path / "whole")
    ]
    best = [folder / "best.safetensors" for folder in (tmp_path / "whole", resumed)]
    kept, again_kept = map(tensors_in, best)
    assert all(torch.equal(value, again_kept[name]) for name, value in kept.items())
    assert len({checkpoint.progress_of(file)["last_score"] for file in best}) == 1


def test_a_killed_run_keeps_a_best_agent_from_after_its_checkpoint(scores, tmp_path):
    words = [*PLATFORM, "total_frames=192", "save_best=true", "checkpoint_every=64"]
    scores += [0.0, 1.0, 2.0, 9.0]
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemError):
        kill_at(patch, 128)
        run(compose_config(words), tmp_path / "killed", words)
    assert checkpoint.progress_of(tmp_path / "killed/checkpoint.safetensors")["frames"] == 64
    kept = tensors_in(tmp_path / "killed/best.safetensors")
    scores += [0.0, 3.0, 4.0, 5.0, 6.0]  # of random actions first; the episodes of the resumed run may be other ones
    folder = tmp_path / "killed"
    again = [f"resume={tmp_path / 'killed'}"]
    assert run(compose_config(again), folder, again) == 0
    best = checkpoint.progress_of(folder / "best.safetensors")
    assert (best["frames"], best["last_score"]) == (96, 9.0)
    assert all(torch.equal(value, kept[name]) for name, value in tensors_in(folder / "best.safetensors").items())


def test_a_best_agent_is_known_to_a_run_whose_checkpoint_had_no_callback(scores, tmp_path):
    scores += [0.0, 9.0, 0.0, 0.0]  # the last one is that of the summary
    words = [*PLATFORM, "total_frames=64"]
    assert run(compose_config([*words, "save_best=true"]), tmp_path, words) == 0
    for length, is_kept in ((96, "false"), (128, "true")):
        scores += [0.0, 1.0, 1.0]
        again = [f"resume={tmp_path}", f"total_frames={length}", f"save_best={is_kept}"]
        assert run(compose_config(again), tmp_path, again) == 0
    assert checkpoint.progress_of(tmp_path / "best.safetensors")["last_score"] == 9.0


def test_a_best_agent_that_cannot_be_read_is_told_in_one_line(tmp_path, capsys):
    assert start(tmp_path, "save_best=true", "total_frames=64") == 0
    (tmp_path / "best.safetensors").write_text("no agent")
    words = [f"resume={tmp_path}", "total_frames=96"]
    assert run(compose_config(words), tmp_path, words) == 1
    assert f"BestAgent: {tmp_path / 'best.safetensors'}: damaged" in capsys.readouterr().err


def test_a_run_that_a_callback_ended_is_finished(tmp_path, capsys):
    words = [*SMALL, "callbacks=[{name:patience,evaluations:1}]", "total_frames=6400"]
    assert run(compose_config(words), tmp_path, words) == 0
    printed = capsys.readouterr().out
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["frames"] < 6400 and summary["finished"]
    assert f"Training ended at {summary['frames']} steps: 1 evaluations without an improvement" in printed
    assert rest_of(make_config(words), tmp_path).score == summary["score"]
    with pytest.raises(ConfigError, match=r"another config, with callbacks="):
        rest_of(make_config([*SMALL, "total_frames=6400"]), tmp_path)
    assert rest_of(make_config([*words, "save_best=true"]), tmp_path).score == summary["score"]


def test_a_dropped_callback_with_a_state_is_told(tmp_path, capsys):
    assert start(tmp_path / "a", "total_frames=64", "callbacks=[patience,time_limit]") == 0
    words = [f"resume={tmp_path / 'a'}", "total_frames=128", "callbacks=[]"]
    assert run(compose_config(words), tmp_path / "b", words) == 0
    assert "the checkpoint holds the state of Patience, but this run has no such callback" in capsys.readouterr().err


def test_a_run_with_callbacks_of_ones_own_is_scored_and_watched_without_their_yaml_files(tmp_path, monkeypatch):
    assert start(tmp_path / "a", "callbacks=[recording]", "total_frames=64") == 0
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)
    words = ["hydra.searchpath=[]", "mode=eval", f"checkpoint={tmp_path / 'a'}"]
    assert run(compose_config(words), tmp_path / "b", words) == 0
    config: Config = load_agent(str(tmp_path / "a"), []).config
    assert config.callbacks == ()


def test_a_new_run_does_not_overwrite_a_best_agent_that_a_killed_run_left(tmp_path):
    assert start(tmp_path, "save_best=true", "total_frames=64") == 0
    for name in ("summary.json", "checkpoint.safetensors", "policy.safetensors"):
        (tmp_path / name).unlink()
    with pytest.raises(ConfigError, match="holds the results of a run"):
        start(tmp_path)
    assert start(tmp_path, "overwrite=true", "save_best=false", "total_frames=64") == 0
    assert not (tmp_path / "best.safetensors").exists()
