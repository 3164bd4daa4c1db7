"""The study of other libraries' learners: the clock that all of them share, and the tables."""

from pathlib import Path

import pytest
import torch
from scripts import load_script

from experiments.study_tables import read_csv, write_tables
from hpamdp import keys

PEERS = Path(__file__).resolve().parent.parent / "experiments" / "peers"


def module(name):
    return load_script(PEERS / f"{name}.py")


@pytest.fixture
def protocol(monkeypatch):
    found = module("protocol")
    monkeypatch.setattr(found, "EPISODES", 8)
    return found


class Clock:
    """CPU seconds that pass only when a test says so."""

    now = 100.0

    def __call__(self):
        return self.now


def leap(td):
    td.set(keys.DISCRETE, torch.full(td.batch_size, 2))
    return td.set(keys.PARAMETERS, torch.tensor([3.0, 10.0, 400.0]).expand(*td.batch_size, 3))


def measured(protocol, monkeypatch, file, limit=40.0, cost_of_scoring=0.0):
    clock = Clock()
    monkeypatch.setattr(protocol, "cpu_seconds", clock)

    def slow(td):
        clock.now += cost_of_scoring
        return leap(td)

    return clock, protocol.Curve("platform", {"greedy": slow}, {"library": "x", "seed": 300}, file, limit)


def test_the_time_of_an_evaluation_is_not_part_of_the_time_of_training(protocol, monkeypatch, tmp_path):
    clock, curve = measured(protocol, monkeypatch, tmp_path / "a.csv", cost_of_scoring=50.0)
    curve.begin()
    for steps in range(10, 90, 10):
        clock.now += 5.0
        assert curve.after(steps) == (steps == 80)
    curve.end(80)
    rows = read_csv(tmp_path / "a.csv")
    assert [row["cpu_s"] for row in rows] == [0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0]
    assert [row["steps"] for row in rows] == list(range(0, 90, 10))


def test_every_evaluation_plays_the_same_episodes_and_leaves_the_random_numbers_alone(protocol, tmp_path):
    curve = protocol.Curve("platform", {"greedy": leap}, {}, tmp_path / "a.csv")
    state = torch.get_rng_state()
    for _ in range(2):
        curve._score(0, 0.0)
    assert curve.rows[0] == curve.rows[1] and curve.rows[0]["score"] > 0.0
    assert torch.equal(state, torch.get_rng_state())


def row(seed, cpu_s, steps, score, learner="pdqn"):
    name = {"problem": "platform", "library": "hpamdp", "version": "1", "learner": learner, "acts": "greedy"}
    return {**name, "seed": seed, "limit_s": 600.0, "cpu_s": cpu_s, "steps": steps, "score": score, "success": score}


def test_a_folder_with_trainings_of_different_lengths_or_with_a_run_twice_is_refused(tmp_path):
    study = module("study")
    run = row(300, 0.0, 0, 0.0)
    write_tables(tmp_path, {"a": [run], "b": [row(301, 0.0, 0, 0.0) | {"limit_s": 900.0}]})
    with pytest.raises(
        SystemExit, match=r"b\.csv: has limit_s=900\.0, and files before it 600\.0; nothing was written"
    ):
        study.gather(tmp_path)
    write_tables(tmp_path, {"b": [run]})
    with pytest.raises(SystemExit, match="two runs of platform, hpamdp, 1, pdqn, greedy, 300; nothing was written"):
        study.gather(tmp_path)
