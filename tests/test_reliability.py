"""What may go wrong around a run costs no saved work, and is told in one line."""

import itertools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import resource_tracker
from pathlib import Path
from typing import IO, Any

import pytest
import torch
from conftest import CONF, compose_config, parts_of
from test_grid import SHORT

from hpamdp import cli, keys
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.run import checkpoint
from hpamdp.run.folder import is_about_folder
from hpamdp.run.train import run
from hpamdp.run_files import DIVERGED_NAME

SMALL = ["num_envs=8", "steps_per_batch=4", "total_frames=512", "eval.layouts=4", "eval.every=0", "high=ucb"]
PROGRAM = ["run.py", "num_envs=8", "steps_per_batch=4", "eval.layouts=4", "low=random"]


def frames_of(folder) -> int:
    return checkpoint.progress_of(folder / "checkpoint.safetensors")["frames"]


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


def test_a_reward_that_is_not_finite_stops_the_run_and_keeps_the_good_checkpoint(tmp_path, monkeypatch, capsys):
    value = float("nan")
    given = [*SMALL, "low=random", "checkpoint_every=64", "total_frames=8192"]
    spoil_rewards(monkeypatch, value, after=150)  # well after the evaluations at the start
    assert run(compose_config(given), tmp_path, given) == 3
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "frame" in line and "stopped" in line]
    assert line.startswith(f"reward is {value} in environment 0 at frame ") and "last good checkpoint is" in line
    frames = checkpoint.progress_of(tmp_path / "checkpoint.safetensors")["frames"]
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
    assert 0 < frames_of(tmp_path / "failed") < 8192
    words = [f"resume={tmp_path / 'failed'}", f"total_frames={frames_of(tmp_path / 'failed') + 64}"]
    assert run(compose_config(words), tmp_path / "resumed", words) == 0


def test_a_loss_that_is_nan_stops_the_run_before_it_is_saved(tmp_path, monkeypatch, capsys):
    given = [*SMALL, "low=pdqn", *SHORT["pdqn"], "checkpoint_every=128"]
    update_once, steps = PDQN.update_once, itertools.count()

    def spoiled(self, sample):
        if next(steps) == 8:
            with torch.no_grad():
                next(self.critics.parameters()).fill_(torch.nan)
        return update_once(self, sample)

    monkeypatch.setattr(PDQN, "update_once", spoiled)
    assert run(compose_config(given), tmp_path, given) == 3
    assert "/critic is nan at frame" in capsys.readouterr().err
    agent = parts_of(tmp_path / "checkpoint.safetensors")["agent"]
    assert not any(value.isnan().any() for value in agent.values() if torch.is_tensor(value))


def program(folder: Path, words: Sequence[str], output: IO[str] | int) -> multiprocessing.Process:
    """Start the program in a process forked from this one, as the imports take longer than a run.

    Args:
        folder: its working directory.
        words: of the command line.
        output: where its output and its errors go.
    """
    process = multiprocessing.get_context("fork").Process(target=_main, args=(folder, words, output))
    process.start()
    return process


def _main(folder: Path, words: Sequence[str], output: IO[str] | int) -> None:
    os.chdir(folder)
    number = output if isinstance(output, int) else output.fileno()
    os.dup2(number, 1)
    os.dup2(number, 2)
    _close(3)  # as in a program of its own; a pipe would still have its reader
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115  # pytest has replaced these
    sys.stderr = open(2, "w", closefd=False)  # noqa: SIM115
    signal.signal(signal.SIGINT, signal.default_int_handler)  # as in a terminal, where Ctrl-C is not ignored
    sys.argv = [*PROGRAM, *words]
    cli.main()


def _close(first: int) -> None:
    """Close all files from this number on, that of the parent's resource tracker too, and forget the tracker."""
    os.closerange(first, 1000)
    resource_tracker._resource_tracker._fd = None


def interpreter(folder: Path, words: Sequence[str], output: IO[str] | int) -> subprocess.Popen:
    """Start the program as `program` does, but in an interpreter of its own, whose end counts."""
    # As in a terminal, where Ctrl-C is not ignored.
    reset = lambda: signal.signal(signal.SIGINT, signal.default_int_handler)  # noqa: E731
    command = [sys.executable, str(CONF.parent / PROGRAM[0]), *PROGRAM[1:], *words]
    return subprocess.Popen(command, cwd=folder, preexec_fn=reset, stdout=output, stderr=output)


def started(folder: Path, *words: str, output: IO[str] | int, start: Callable[..., Any] = program) -> Any:
    """Start an endless run and wait until it has logged."""
    endless = ["total_frames=100000000", "log_every=32", "eval.every=0", f"hydra.run.dir={folder}"]
    process = start(folder.parent, [*endless, *words], output)
    metrics = folder / "metrics.csv"
    for _ in range(4800):
        if metrics.is_file() and len(metrics.read_text().splitlines()) > 3:
            return process
        time.sleep(0.05)
    process.kill()
    raise AssertionError("nothing was logged")


@pytest.fixture
def printed(tmp_path) -> Iterator[IO[str]]:
    """A file for what a program prints."""
    with (tmp_path / "printed.txt").open("w+") as file:
        yield file


@pytest.mark.slow
def test_ctrl_c_saves_when_the_reader_of_its_output_is_gone(tmp_path):
    read, write = os.pipe()
    process = started(tmp_path / "run", output=write, start=interpreter)
    os.close(write)
    os.close(read)  # `tee` gets the Ctrl-C as well, and is gone first
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130
    assert frames_of(tmp_path / "run") > 0
    assert not json.loads((tmp_path / "run/summary.json").read_text())["finished"]


@pytest.mark.parametrize("collector", ["single", pytest.param("multi", marks=pytest.mark.slow)])
def test_a_run_in_a_thread_is_the_run_of_the_main_thread(collector, tmp_path):
    given = [*SMALL, "low=random", f"collector={collector}"]
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(run, compose_config(given), tmp_path / "thread", given).result() == 0
    assert run(compose_config(given), tmp_path / "main", given) == 0
    scores = [json.loads((tmp_path / name / "summary.json").read_text())["score"] for name in ("thread", "main")]
    assert scores[0] == scores[1]


def test_a_killed_run_loses_no_more_than_the_minutes_between_two_checkpoints(tmp_path, printed):
    process = started(tmp_path / "run", "checkpoint_minutes=0.002", output=printed)
    for _ in range(600):
        if (tmp_path / "run/checkpoint.safetensors").exists():
            break
        time.sleep(0.05)
    process.kill()
    process.join()
    assert frames_of(tmp_path / "run") > 0
    words = [f"resume={tmp_path / 'run'}", f"total_frames={frames_of(tmp_path / 'run') + 64}"]
    assert run(compose_config(words), tmp_path / "resumed", words) == 0


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("resume=", 'resume="": must have at least 1 character'),
        ("low.checkpoint=", 'low.checkpoint="": must have at least 1 character'),
        ("hydra.run.dir=", "hydra.run.dir: the working directory"),
        ("hydra.sweep.dir=", "hydra.sweep.dir: the working directory"),
    ],
)
def test_an_empty_folder_name_is_refused_in_one_line(word, line, command):
    code, _, err = command(*(["-m"] if "sweep" in word else []), word, *SMALL, "low=random")
    assert code == 2 and err.count("\n") == 1 and line in err


@pytest.mark.parametrize(
    ("error", "is_told"),
    [
        (OSError(28, "No space left on device", "{folder}/metrics.csv"), True),
        (OSError(28, "No space left on device", "/dev/shm/sem.mp-1"), False),
        (OSError(30, "Read-only file system", "/elsewhere"), False),
    ],
)
def test_a_full_disk_is_blamed_on_the_runs_folder_only_if_a_file_there_is_meant(error, is_told, tmp_path):
    if error.filename is not None:
        error.filename = error.filename.format(folder=tmp_path)
    assert is_about_folder(error, tmp_path) is is_told
