"""The study of other libraries' learners: the clock that all of them share, and the tables."""

from pathlib import Path

import pytest
import torch
from scripts import load_script

from hpamdp import keys
from hpamdp.analysis.study import read_csv, write_tables

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


def test_evaluations_become_rarer_and_a_learner_that_ends_early_is_scored_at_its_end(protocol, monkeypatch, tmp_path):
    clock, curve = measured(protocol, monkeypatch, tmp_path / "a.csv", limit=600.0)
    curve.begin()
    for steps in range(1, 200):
        clock.now += 1.0
        assert not curve.after(steps)
    clock.now += 0.5
    curve.end(199)
    times = [row["cpu_s"] for row in read_csv(tmp_path / "a.csv")]
    assert times[-1] == 199.5 and times[:4] == [0.0, 5.0, 10.0, 15.0]
    assert max(times[i + 1] - times[i] for i in range(len(times) - 1)) > 20.0


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


def test_a_score_at_a_time_is_the_last_one_within_it_and_the_end_of_the_time_comes_a_batch_later():
    study = module("study")
    run = [row(300, cpu_s, 0, cpu_s / 1000) for cpu_s in (0.0, 50.0, 110.0, 601.0)]
    assert [study.at(run, cpu_s)["cpu_s"] for cpu_s in (60.0, 120.0, 599.0, 600.0)] == [50.0, 110.0, 110.0, 601.0]


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
