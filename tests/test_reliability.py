"""What may go wrong around a run costs no saved work, and is told in one line."""

import itertools
import json
import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from conftest import CONF, compose_config
from test_grid import SHORT

from hpamdp import keys
from hpamdp.config import ConfigError
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.run import checkpoint
from hpamdp.run.train import DIVERGED_NAME, run

SMALL = ["num_envs=8", "steps_per_batch=4", "total_frames=512", "eval.layouts=4", "eval.every=0", "high=ucb"]
PROGRAM = [
    sys.executable,
    str(CONF.parent / "run.py"),
    "num_envs=8",
    "steps_per_batch=4",
    "eval.layouts=4",
    "low=random",
]


def spoil_rewards(monkeypatch, value: float, after: int) -> None:
    """Have the boats' rewards be `value` from a step on."""
    step, steps = BoatDockEnv._step, itertools.count()

    def spoiled(self, td):
        following = step(self, td)
        return (
            following.set(keys.REWARD, torch.full_like(following[keys.REWARD], value))
            if next(steps) > after
            else following
        )

    monkeypatch.setattr(BoatDockEnv, "_step", spoiled)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_reward_that_is_not_finite_stops_the_run_and_keeps_the_good_checkpoint(value, tmp_path, monkeypatch, capsys):
    given = [*SMALL, "low=random", "checkpoint_every=64", "total_frames=8192"]
    spoil_rewards(monkeypatch, value, after=150)  # well after the evaluations at the start
    assert run(compose_config(given), tmp_path, given) == 3
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "frame" in line and "stopped" in line]
    assert line.startswith(f"reward is {value} in environment 0 at frame ") and "last good checkpoint is" in line
    frames = checkpoint.progress_of(tmp_path / "checkpoint.zip")["frames"]
    assert 0 < frames < 8192 and checkpoint.progress_of(tmp_path / DIVERGED_NAME)["frames"] >= frames
    assert not (tmp_path / "summary.json").exists()


def test_rewards_whose_sum_overflows_stop_the_run(tmp_path, monkeypatch, capsys):
    given = [*SMALL, "low=random", "total_frames=8192"]
    spoil_rewards(monkeypatch, 3e38, after=150)
    assert run(compose_config(given), tmp_path, given) == 3
    assert "episode_return is inf in environment" in capsys.readouterr().err


def test_an_error_in_the_environment_saves_what_was_learned_and_is_raised_as_it_is(tmp_path, monkeypatch):
    given = [*SMALL, "low=random", "total_frames=8192"]
    step, steps = BoatDockEnv._step, itertools.count()

    def failing(self, tensordict):
        if next(steps) > 150:
            raise RuntimeError("a bug in step")
        return step(self, tensordict)

    with monkeypatch.context() as patch, pytest.raises(RuntimeError, match="a bug in step"):
        patch.setattr(BoatDockEnv, "_step", failing)
        run(compose_config(given), tmp_path / "failed", given)
    assert 0 < checkpoint.progress_of(tmp_path / "failed/checkpoint.zip")["frames"] < 8192
    assert run(compose_config([f"resume={tmp_path / 'failed'}"]), tmp_path / "resumed", []) == 0


def test_a_loss_that_is_nan_stops_the_run_before_it_is_saved(tmp_path, monkeypatch, capsys):
    given = [*SMALL, "low=pdqn", *SHORT["pdqn"], "checkpoint_every=128"]
    train_step, steps = PDQN.train_step, itertools.count()

    def spoiled(self, sample):
        if next(steps) == 8:
            with torch.no_grad():
                next(self.critics.parameters()).fill_(torch.nan)
        return train_step(self, sample)

    monkeypatch.setattr(PDQN, "train_step", spoiled)
    assert run(compose_config(given), tmp_path, given) == 3
    assert "/critic is nan at frame" in capsys.readouterr().err
    _, members = checkpoint._read(tmp_path / "checkpoint.zip", {"agent"})
    assert not any(value.isnan().any() for value in members["agent"].values() if torch.is_tensor(value))


def started(folder, *words, **streams) -> subprocess.Popen:
    """Start an endless run and wait until it has logged."""
    words = ["total_frames=100000000", "log_every=32", "eval.every=0", f"hydra.run.dir={folder}", *words]
    # As in a terminal, where Ctrl-C is not ignored.
    reset = lambda: signal.signal(signal.SIGINT, signal.default_int_handler)  # noqa: E731
    process = subprocess.Popen([*PROGRAM, *words], cwd=folder.parent, preexec_fn=reset, **streams)
    metrics = folder / "metrics.csv"
    for _ in range(1200):
        if metrics.is_file() and len(metrics.read_text().splitlines()) > 3:
            return process
        assert process.poll() is None
        time.sleep(0.05)
    process.kill()
    raise AssertionError("nothing was logged")


def frames_of(folder) -> int:
    return checkpoint.progress_of(folder / "checkpoint.zip")["frames"]


def test_ctrl_c_saves_when_the_reader_of_its_output_is_gone(tmp_path):
    read, write = os.pipe()
    process = started(tmp_path / "run", stdout=write, stderr=write)
    os.close(write)
    os.close(read)  # `tee` gets the Ctrl-C as well, and is gone first
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130
    assert frames_of(tmp_path / "run") > 0
    assert not json.loads((tmp_path / "run/summary.json").read_text())["finished"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_run_whose_output_is_full_goes_on_and_saves(tmp_path):
    with open("/dev/full", "w") as full:
        process = started(tmp_path / "run", stdout=full, stderr=full)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 130
    assert frames_of(tmp_path / "run") > 0


def test_a_killed_run_loses_no_more_than_the_minutes_between_two_checkpoints(tmp_path):
    process = started(tmp_path / "run", "checkpoint_minutes=0.002", stderr=subprocess.DEVNULL)
    for _ in range(600):
        if (tmp_path / "run/checkpoint.zip").exists():
            break
        time.sleep(0.05)
    process.kill()
    process.wait()
    assert frames_of(tmp_path / "run") > 0
    words = [f"resume={tmp_path / 'run'}", f"total_frames={frames_of(tmp_path / 'run') + 64}"]
    assert run(compose_config(words), tmp_path / "resumed", words) == 0


def test_a_second_run_in_the_folder_of_one_that_runs_is_refused(tmp_path):
    process = started(tmp_path / "run", stderr=subprocess.DEVNULL)
    done = subprocess.run([*PROGRAM, f"hydra.run.dir={tmp_path / 'run'}"], capture_output=True, text=True, cwd=tmp_path)
    process.kill()
    process.wait()
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "another process is at work in this folder" in done.stderr


def test_a_folder_with_results_is_refused_unless_they_may_be_overwritten(tmp_path):
    given = [*SMALL, "low=random"]
    assert run(compose_config(given), tmp_path, given) == 0
    before = (tmp_path / "summary.json").read_bytes()
    with pytest.raises(ConfigError, match="holds the results of a run; continue it with resume="):
        run(compose_config(given), tmp_path, given)
    assert (tmp_path / "summary.json").read_bytes() == before
    assert run(compose_config([*given, "overwrite=true"]), tmp_path, given) == 0


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("resume=", "resume: empty; give the output folder of a run"),
        ("low.checkpoint=", "low.checkpoint: empty"),
        ("hydra.run.dir=", "hydra.run.dir: the working directory"),
    ],
)
def test_an_empty_folder_name_is_refused_in_one_line(word, line, command):
    code, _, err = command(word, *SMALL, "low=random")
    assert code == 2 and err.count("\n") == 1 and line in err


def test_a_folder_that_is_deleted_while_the_run_goes_on_ends_it_in_one_line(tmp_path):
    process = started(tmp_path / "run", stderr=subprocess.PIPE, text=True)
    subprocess.run(["rm", "-rf", str(tmp_path / "run")], check=True)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    (line,) = [line for line in err.replace("\r", "\n").splitlines() if line and "steps/s" not in line]
    assert str(tmp_path / "run") in line and "No such file" in line
