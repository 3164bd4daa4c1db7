"""The reader returns exactly what the recording holds, and refuses any other file in one line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import synthetic_human
import torch

from hpamdp.data import DataError
from hpamdp.data.human import released_file
from hpamdp.data.human.released_file import read
from hpamdp.env.boatdock import harbour
from hpamdp.env.boatdock.task import Outcome

OUTCOMES = {1: Outcome.OUT_OF_FUEL, 2: Outcome.SUCCESS, 3: Outcome.TOO_FAST, 4: Outcome.OUT_OF_BOUNDS}


def test_tables_hold_the_recording(tmp_path):
    people = synthetic_human.recording()
    data = read(synthetic_human.write(tmp_path / "people.mat", people), checksum=None)
    row = 0
    flat = [(p, i, raw) for p, person in enumerate(people) for i, raw in enumerate(person)]
    assert len(data.episodes) == len(flat)
    episodes, columns = ({name: values.numpy() for name, values in table.items()} for table in data)
    for number, (p, i, raw) in enumerate(flat):
        fields = {name: np.ravel(values).astype(float) for name, values in raw.items()}
        episode = {name: values[number] for name, values in episodes.items()}
        num = fields["gas"].size
        assert (episode["person"], episode["index"], episode["presses"]) == (p, i, num)
        assert (episode["controller"], episode["keymap"]) == (fields["boatchoice"], fields["incongkm"])
        assert (episode["tank"], episode["outcome"]) == (fields["tank"], OUTCOMES[int(fields["outcome"][0])])
        for name, values in (("start", fields["SG"][::2]), ("goal", fields["SG"][1::2]), ("centre", fields["center"])):
            assert np.array_equal(episode[name], values.astype(np.float32))
        assert episode["complete"] == (abs(fields["tank"] + 60 * fields["actions"].sum() - 360) <= 2.5)
        rows = slice(row, row + num)
        assert (columns["episode"][rows] == number).all() and (columns["press"][rows] == np.arange(num)).all()
        assert (columns["is_final"][rows] == (np.arange(num) == num - 1)).all()
        actions = fields["actions"].reshape(-1, 3)
        assert (columns["key"][rows] == [np.flatnonzero(a)[0] for a in actions]).all()
        for name, values in (
            ("duration", actions.sum(1)),
            ("speed", 10.0 * fields["velocity"].reshape(-1, 3).sum(1)),
            ("distance", fields["distance"]),
            ("gas", fields["gas"]),
        ):
            assert np.array_equal(columns[name][rows], values.astype(np.float32)), name
        obs, after = (fields[name].reshape(-1, 2).astype(np.float32) for name in ("obs", "next_obs"))
        assert np.array_equal(columns["position"][rows][:-1], obs)
        assert np.array_equal(columns["next_position"][rows][:-1], after)
        assert num == 0 or np.isnan(columns["next_position"][rows][-1]).all()
        row += num
    assert row == len(data.presses)


def test_released_file_has_the_published_counts(people):
    episodes, presses = people
    assert len(episodes) == 14_400 and len(presses) == 46_757
    assert (episodes["person"].bincount() == 360).all() and len(episodes["person"].unique()) == 40
    assert episodes["block"].bincount().tolist() == [2400] * 6
    assert (episodes["presses"] == 0).sum() == 15 and (episodes["presses"] < 2).sum() == 1838
    assert (episodes["centre"] == torch.tensor([672.0, 504.0])).all(1).sum() == 7200
    assert episodes["person"][episodes["keymap"] == 2].unique().numel() == 4
    assert presses["duration"].max() == pytest.approx(1.965, abs=1e-3)


def test_one_frame_moves_every_point_to_the_environments_centre(tmp_path):
    path = synthetic_human.write(tmp_path / "people.mat")
    as_seen, moved = read(path, checksum=None), read(path, checksum=None, one_frame=True)
    assert (moved.episodes["centre"] == torch.tensor(harbour.CENTRE)).all()
    shift = moved.episodes["centre"] - as_seen.episodes["centre"]
    assert shift.unique(dim=0).tolist() == [[-32.0, 8.0], [0.0, 0.0]]
    for name in ("start", "goal"):
        torch.testing.assert_close(moved.episodes[name], as_seen.episodes[name] + shift, atol=1e-4, rtol=0)
    for name in ("position", "next_position"):
        expected = as_seen.presses[name] + shift[as_seen.presses["episode"]]
        torch.testing.assert_close(moved.presses[name], expected, atol=1e-4, rtol=0, equal_nan=True)


def refusal(path: Path, **arguments: str | None) -> str:
    with pytest.raises(DataError) as caught:
        read(path, **arguments)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 1000
    return str(caught.value)


def test_a_file_that_is_not_the_released_one_is_refused_by_its_checksum(tmp_path):
    path = synthetic_human.write(tmp_path / "people.mat")
    assert re.search(r"people.mat: SHA-256 .* but the released file has 9de16874b43d", refusal(path))
    assert "there is no such file; set HPAMDP_HUMAN_DATA" in refusal(tmp_path / "none.mat")
    assert "is a folder, a pipe or a device, but must be a regular file" in refusal(tmp_path)


def test_default_path_is_that_of_the_environment_variable_or_in_the_cache(monkeypatch, tmp_path):
    monkeypatch.setenv(released_file.PATH_VARIABLE, str(tmp_path / "mine.mat"))
    assert released_file.default_path() == tmp_path / "mine.mat"
    monkeypatch.delenv(released_file.PATH_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert released_file.default_path().name == "BDtrajectory40.mat"


@pytest.mark.parametrize("form", ["zip", "cut", "another variable"])
def test_foreign_files_are_refused(tmp_path, form):
    path = synthetic_human.write(tmp_path / "foreign.mat", [synthetic_human.recording()[0][:2]])
    if form == "another variable":
        scipy.io.savemat(path, {"x": 1.0})
    else:
        path.write_bytes({"zip": b"PK\x03\x04" * 100, "cut": path.read_bytes()[:-99]}[form])
    assert "this is not a MATLAB file with people's trajectories" in refusal(path, checksum=None)


def test_an_unknown_code_is_refused(tmp_path):
    people = synthetic_human.recording()
    people[1][0]["outcome"] = people[1][0]["outcome"] + 4
    assert "outcome is not 1 or 2 or 3 or 4" in refusal(
        synthetic_human.write(tmp_path / "a.mat", people), checksum=None
    )


def test_people_who_never_pressed_a_key_are_read(tmp_path):
    people = synthetic_human.recording()
    silent = [episode for episodes in people for episode in episodes if not episode["gas"].size]
    episodes, presses = read(synthetic_human.write(tmp_path / "a.mat", [silent]), checksum=None)
    assert len(episodes) == len(silent) > 0 and len(presses) == 0
