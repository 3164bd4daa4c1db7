"""A run from start to end: what it leaves behind, that it can be stopped, resumed and scored again."""

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from unittest import mock

import numpy as np
import pytest
import torch
from conftest import compose_config, make_config, rows_of, signal_after
from PIL import Image

import hpamdp
from hpamdp.config.errors import ConfigError
from hpamdp.env.boatdock import harbour
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.reference import human_normalised
from hpamdp.messages import duration
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.run import checkpoint
from hpamdp.run.assemble import assemble
from hpamdp.run.evaluate import Evaluation
from hpamdp.run.stopping import stop_on_signals
from hpamdp.run.train import run

SMALL = ["num_envs=32", "steps_per_batch=4", "eval.layouts=20", "total_frames=1024", "eval.every=512"]
FILES = {"config.yaml", "metrics.csv", "summary.json", "evaluation.npz", "checkpoint.safetensors", "policy.safetensors"}
PICTURES = {"learning_curves.png", "trajectories.png", "choices.png"}


def start(output_dir, *overrides):
    return run(compose_config([*SMALL, *overrides]), output_dir, list(overrides))


def test_a_run_leaves_numbers_pictures_and_a_closing_table(tmp_path, capsys, with_figures):
    assert start(tmp_path, "high=uniform", "low=random") == 0
    files = {file.name for file in tmp_path.iterdir()}
    assert files >= FILES | PICTURES and "episodes.gif" not in files, "film=false"
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {"score", "success", "too_fast", "steps", "option_congruent", "oracle_agreement", "optimality_gap"} <= {
        *summary
    }
    assert {"frames", "wall_s", "seed", "versions", "ceiling"} <= {*summary}
    assert summary["frames"] == 1024 and summary["episodes"] == 20
    assert summary["human_normalised"] == human_normalised(summary["score"])
    printed = capsys.readouterr().out
    assert "score" in printed and "ceiling" in printed and str(tmp_path) in printed


class Compiles(hpamdp.Callback):
    """Stands for an update that another process compiles."""

    def on_start(self, trainer):
        with trainer.parts.agent.learners[0].while_compiling():
            subprocess.run([sys.executable, "-c", "sum(range(20_000_000))"], check=True)


def test_the_cpu_time_of_a_run_counts_the_compilers(tmp_path):
    short = {"high": None, "num_envs": 4, "steps_per_batch": 4, "total_frames": 16, "eval.layouts": 2, "film": False}
    hpamdp.train("platform", low="random", folder=tmp_path, callbacks=[Compiles()], **short)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["cpu_s"] >= summary["compile_cpu_s"] > 0.2


def test_a_run_leaves_a_film_of_three_episodes(tmp_path):
    start(tmp_path, "high=uniform", "low=random", "total_frames=128", "eval.every=0", "film=true")
    with Image.open(tmp_path / "episodes.gif") as film:
        assert film.size == (600, 200) and film.n_frames > 10


def test_the_planner_under_the_oracle_reaches_the_ceiling_with_nothing_to_learn(tmp_path):
    start(tmp_path, "high=oracle", "low=planner", "total_frames=128", "eval.layouts=50")
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["optimality_gap"] == pytest.approx(0.0, abs=1e-3)
    assert summary["oracle_agreement"] == 1.0 and summary["success"] == 1.0


def test_the_same_seed_gives_the_same_run_and_another_seed_another(tmp_path):
    learner = ["low=hyar", "low.warmup_steps=256", "low.codec_pretrain_updates=5", "low.updates_per_step=0.02"]
    learner += ["total_frames=512", "eval.every=256"]
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        start(tmp_path / name, *learner, f"seed={seed}")
    first, second, third = (rows_of(tmp_path / name) for name in "abc")
    for one, other in zip(first, second, strict=True):
        times = {"wall_s": "", "cpu_s": ""}
        assert one | times == other | times
    assert first[-1] != third[-1]


def test_evaluations_move_no_random_generator_of_the_training(tmp_path):
    start(tmp_path / "often", "low=random", "total_frames=512", "eval.every=128")
    start(tmp_path / "seldom", "low=random", "total_frames=512", "eval.every=512")
    often, seldom = (rows_of(tmp_path / name)[-1] for name in ("often", "seldom"))
    assert often["eval/score"] == seldom["eval/score"]
    states = []
    for name in ("often", "seldom"):
        file = checkpoint.find(tmp_path / name, "resume")
        parts = assemble(make_config([*SMALL, "low=random"]))
        saved = checkpoint.load(file, parts.agent, torch.device("cpu"), with_training=True)
        states.append(saved.states["collection"]["env"])
    assert all(torch.equal(states[0][column], states[1][column]) for column in states[0])


def test_training_ends_at_the_first_evaluation_that_reaches_the_stop_score(tmp_path, monkeypatch):
    measure, rising = Evaluation.measure, itertools.count()
    monkeypatch.setattr(Evaluation, "measure", lambda *given: measure(*given) | {"score": float(next(rising))})
    # Scored 0 are random presses, 1 is the start.
    assert start(tmp_path, "low=random", "total_frames=4096", "eval.stop_score=3") == 0
    assert [(row["frames"], row["eval/score"]) for row in rows_of(tmp_path)][-2:] == [
        ("512.0", "2.0"),
        ("1024.0", "3.0"),
    ]
    assert checkpoint.progress_of(tmp_path / "checkpoint.safetensors")["frames"] == 1024
    assert json.loads((tmp_path / "summary.json").read_text())["finished"]
    # Nothing is left to do, unless a higher score is asked for. A resumed run knows the score of random presses.
    for name, score, frames in (("same", 3.0, 1024), ("higher", next(rising) + 2.0, 1536)):
        words = [f"resume={tmp_path}", f"eval.stop_score={score}"]
        assert run(compose_config(words), tmp_path / name, words) == 0
        assert json.loads((tmp_path / name / "summary.json").read_text())["frames"] == frames


def test_ctrl_c_saves_says_how_to_resume_and_resuming_ends_the_run(tmp_path, capsys):
    with signal_after(5):
        assert start(tmp_path / "stopped", "low=random", "total_frames=100_000_000", "eval.every=0") == 130
    printed = capsys.readouterr().out
    assert f"resume={tmp_path / 'stopped'}" in printed
    stopped = json.loads((tmp_path / "stopped" / "summary.json").read_text())
    assert 0 < stopped["frames"] <= 5 * 128 and not stopped["finished"]
    (before,) = rows_of(tmp_path / "stopped")
    played = np.load(tmp_path / "stopped" / "evaluation.npz")["score"].mean()
    assert float(before["eval/score"]) == stopped["score"] == pytest.approx(played)
    assert stopped["evaluated_frames"] == 0 and "of the agent after 0 frames" in printed
    total = stopped["frames"] + 256
    more = [f"resume={tmp_path / 'stopped'}", f"total_frames={total}"]
    assert run(compose_config(more), tmp_path / "resumed", more) == 0
    resumed = json.loads((tmp_path / "resumed" / "summary.json").read_text())
    assert resumed["frames"] >= total and resumed["wall_s"] > stopped["wall_s"]
    after = rows_of(tmp_path / "resumed")
    assert [row["frames"] for row in after] == ["0.0", str(float(resumed["frames"]))]


def test_ctrl_c_ends_an_evaluation_at_once_and_resuming_repeats_it(tmp_path, monkeypatch):
    step, steps = BoatDockEnv._step, itertools.count(1)

    def interrupted(self, td):
        if self.num_envs == 8 and next(steps) == 40:
            os.kill(os.getpid(), signal.SIGTERM)
            pytest.fail("the evaluation went on")
        return step(self, td)

    whole = ["low=random", "high=ucb", "eval.layouts=8", "eval.every=128", "total_frames=512"]
    start(tmp_path / "whole", *whole)
    monkeypatch.setattr(BoatDockEnv, "_step", interrupted)
    assert start(tmp_path / "stopped", *whole) == 130
    summary = json.loads((tmp_path / "stopped" / "summary.json").read_text())
    assert summary["evaluated_frames"] == summary["frames"] - 128
    more = [f"resume={tmp_path / 'stopped'}"]
    assert run(compose_config(more), tmp_path / "resumed", more) == 0
    rows = [[(row["frames"], row["eval/score"]) for row in rows_of(tmp_path / name)] for name in ("whole", "resumed")]
    assert rows[0] == rows[1]


def test_a_run_that_is_stopped_in_its_first_evaluation_plays_no_other(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Evaluation, "run_agent", mock.Mock(side_effect=[KeyboardInterrupt]))
    assert start(tmp_path, "low=random") == 130
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["frames"] == 0 and not summary["finished"] and not {"score", "evaluated_frames"} & {*summary}
    assert "Stopped at 0 steps; to go on: " in capsys.readouterr().out


def test_a_resumed_run_that_is_stopped_before_its_first_evaluation_tells_the_last_one(tmp_path, monkeypatch, capsys):
    start(tmp_path / "run", "low=random")
    before = json.loads((tmp_path / "run" / "summary.json").read_text())
    monkeypatch.setattr(Evaluation, "run_agent", lambda *_: pytest.fail("an evaluation was played"))
    words = [f"resume={tmp_path / 'run'}", "total_frames=100_000_000", "eval.every=0"]
    with signal_after(2):
        assert run(compose_config(words), tmp_path / "more", words) == 130
    assert "these figures are of the agent after 1,024 frames" in capsys.readouterr().out
    after = json.loads((tmp_path / "more" / "summary.json").read_text())
    assert after["frames"] > after["evaluated_frames"] == before["frames"]
    assert {name: after[name] for name in ("score", "steps", "references")} == {
        name: before[name] for name in ("score", "steps", "references")
    }


def test_a_signal_in_the_batch_before_an_evaluation_leaves_it_to_the_resumed_run():
    with stop_on_signals() as request:
        os.kill(os.getpid(), signal.SIGUSR1)
        with pytest.raises(KeyboardInterrupt), request.taken_at_once():
            pytest.fail("the evaluation began")


def test_one_request_that_arrives_twice_does_not_interrupt_an_update(monkeypatch):
    with stop_on_signals() as request:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)  # from make, to which the first one came too
        assert request.signal == signal.SIGTERM
        later = time.monotonic() + 2.0
        monkeypatch.setattr(time, "monotonic", lambda: later)
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)


def test_an_evaluation_that_is_cut_off_leaves_the_film_of_the_one_before(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    parts = assemble(make_config([*SMALL, "low=random", "high=none", "env.controller=congruent"]))
    parts.evaluation.run_agent(parts.agent)
    before = parts.evaluation.states
    monkeypatch.setattr(parts.evaluation, "run", interrupted)
    with pytest.raises(KeyboardInterrupt):
        parts.evaluation.run_agent(parts.agent)
    assert parts.evaluation.states is before


def test_a_second_ctrl_c_within_an_update_tells_the_last_evaluation(tmp_path, monkeypatch):
    learn, batches = HierarchicalAgent.learn, itertools.count(1)

    def interrupted(self, batch):
        scalars = learn(self, batch)
        if next(batches) == 2:
            raise KeyboardInterrupt
        return scalars

    monkeypatch.setattr(HierarchicalAgent, "learn", interrupted)
    assert start(tmp_path, "low=random", "eval.every=128") == 130
    summary = json.loads((tmp_path / "summary.json").read_text())
    rows = rows_of(tmp_path)
    assert [row["frames"] for row in rows] == ["0.0", "128.0"]
    assert float(rows[-1]["eval/score"]) == summary["score"]


def test_a_saved_agent_is_scored_again_with_the_same_result_and_pictures(tmp_path, capsys, draw_all, monkeypatch):
    start(tmp_path / "run", "low=random", "high=uniform")
    words = ["mode=eval", f"checkpoint={tmp_path / 'run'}"]
    with monkeypatch.context() as patch:
        patch.setattr("hpamdp.analysis.figures.draw_all", draw_all)
        assert run(compose_config(words), tmp_path / "scored", words) == 0
    again, first = (json.loads((tmp_path / name / "summary.json").read_text()) for name in ("scored", "run"))
    assert again["score"] == first["score"] and again["high"] == "uniform" and again["low"] == "random"
    assert again["frames"] == 1024
    assert f"1,024 frames of training, evaluated in {duration(again['wall_s'])}" in capsys.readouterr().out
    assert (tmp_path / "scored" / "trajectories.png").is_file()
    words.append("eval.layouts=33")
    run(compose_config(words), tmp_path / "more", words)
    assert len(np.load(tmp_path / "more" / "evaluation.npz")["score"]) == 33


def test_no_score_is_the_mean_of_episodes_that_have_not_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(BoatDockEnv, "max_steps", 1)
    with pytest.raises(ConfigError, match=r"env: .*: evaluation episode 0 has not ended after max_steps=1"):
        start(tmp_path, "low=random")


def test_agents_are_scored_on_the_layouts_that_no_training_meets(tmp_path):
    start(tmp_path, "high=uniform", "low=random", "eval.seed=3")
    with np.load(tmp_path / "evaluation.npz") as played:
        layout = harbour.fixed_layouts(20, 3)
        np.testing.assert_allclose(played["start"], torch.stack(layout[:2], -1).numpy(), atol=1e-4)
        np.testing.assert_allclose(played["path"][:, 0], played["start"], atol=1e-4)
