"""A resumed run is the run that was never stopped, to the last bit."""

import csv
import itertools
import os
import signal
from pathlib import Path

import pytest
import torch
from conftest import TRAINED, compose_config
from test_grid import SHORT

from hpamdp.run import checkpoint
from hpamdp.run.recorder import Recorder
from hpamdp.run.stopping import STOP_SIGNALS
from hpamdp.run.train import run

SMALL = ["num_envs=8", "steps_per_batch=4", "total_frames=640", "eval.layouts=6", "eval.every=256", "log_every=64"]
STOPPED_AFTER = 9  # batches, in the middle of a log interval
SELECTORS = ("ucb", "linucb", "meta_critic", "actor", "exp3")
QUICK = {"meta_critic": ["high.warmup_decisions=20", "high.batch_size=16"], "actor": ["high.minibatch_size=32"]}


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open() as file:
        return [{name: value for name, value in row.items() if name != "wall_s"} for row in csv.DictReader(file)]


def members_of(folder: Path) -> dict:
    _, members = checkpoint._read(folder / checkpoint.FILE_NAME, None)
    return members


def assert_same(one: object, other: object, where: str = "") -> None:
    assert type(one) is type(other), where
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key, value in one.items():
            assert_same(value, other[key], f"{where}/{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), where
        for index, (mine, theirs) in enumerate(zip(one, other, strict=True)):
            assert_same(mine, theirs, f"{where}/{index}")
    elif torch.is_tensor(one):
        torch.testing.assert_close(one, other, rtol=0.0, atol=0.0, equal_nan=True, msg=where)
    else:
        assert one == other, where


def stop_and_resume(given: list[str], tmp_path: Path, monkeypatch, number: int) -> None:
    """Run once as a whole, once with a signal in the middle and a resumption; assert that both come to the same."""
    assert run(compose_config(given), tmp_path / "whole", given) == 0
    take, batches = Recorder.take, itertools.count(1)

    def interrupted(self, batch, scalars):
        take(self, batch, scalars)
        if next(batches) == STOPPED_AFTER:
            os.kill(os.getpid(), number)

    with monkeypatch.context() as patch:
        patch.setattr(Recorder, "take", interrupted)
        assert run(compose_config(given), tmp_path / "stopped", given) == 130
    words = [f"resume={tmp_path / 'stopped'}"]
    torch.manual_seed(1234)  # nothing of another process's generators may matter
    assert run(compose_config(words), tmp_path / "resumed", words) == 0
    assert rows_of(tmp_path / "resumed") == rows_of(tmp_path / "whole")
    whole, resumed = members_of(tmp_path / "whole"), members_of(tmp_path / "resumed")
    for members in (whole, resumed):
        del members["rng"]["python"], members["rng"]["numpy"]  # which no part of a run uses
    assert_same(resumed, whole)


def words_of(high: str, low: str) -> list[str]:
    return [f"high={high}", f"low={low}", *SHORT.get(low, []), *QUICK.get(high, []), *SMALL]


@pytest.fixture(autouse=True)
def no_figures(monkeypatch):
    monkeypatch.setattr("hpamdp.analysis.figures.draw_all", lambda folder, env: [])


@pytest.mark.parametrize(("high", "low"), [*((high, "hppo") for high in SELECTORS), ("ucb", "pdqn")])
def test_a_resumed_run_is_the_run_that_was_never_stopped(high, low, tmp_path, monkeypatch):
    stop_and_resume(words_of(high, low), tmp_path, monkeypatch, signal.SIGINT)


@pytest.mark.parametrize("number", STOP_SIGNALS[1:], ids=lambda number: number.name)
def test_every_signal_that_stops_a_run_saves_it(number, tmp_path, monkeypatch):
    stop_and_resume(words_of("ucb", "random"), tmp_path, monkeypatch, number)


@pytest.mark.slow
@pytest.mark.parametrize(("high", "low"), list(itertools.product(SELECTORS, TRAINED)))
def test_every_pair_resumes_to_the_last_bit(high, low, tmp_path, monkeypatch):
    stop_and_resume(words_of(high, low), tmp_path, monkeypatch, signal.SIGTERM)


@pytest.mark.parametrize("low", ["hppo", pytest.param("pdqn", marks=pytest.mark.slow)])
def test_a_run_with_worker_processes_resumes_to_the_last_bit(low, tmp_path, monkeypatch):
    stop_and_resume([*words_of("ucb", low), "collector=multi"], tmp_path, monkeypatch, signal.SIGTERM)


@pytest.mark.parametrize("env", ["platform", "boatdock_released"])
def test_other_problems_resume_to_the_last_bit(env, tmp_path, monkeypatch):
    given = [*words_of("none", "pdqn"), f"env={env}", "env.max_steps=12"]
    stop_and_resume(given, tmp_path, monkeypatch, signal.SIGTERM)
