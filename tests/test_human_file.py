"""The reader returns exactly what the recording holds, and refuses any other file in one line."""

from __future__ import annotations

import functools
import os
import re
import struct
import time
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import synthetic_human
import torch

from hpamdp.data.errors import DataError
from hpamdp.data.human import released_file
from hpamdp.data.human.released_file import HumanData, read
from hpamdp.env.boatdock import harbour, physics

REAL = os.environ.get(released_file.PATH_VARIABLE)
needs_real = pytest.mark.skipif(not REAL, reason=f"{released_file.PATH_VARIABLE} is not set")
OUTCOMES = {1: physics.OUT_OF_FUEL, 2: physics.SUCCESS, 3: physics.TOO_FAST, 4: physics.OUT_OF_BOUNDS}


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> list[bytes]:
    """Two people, eight episodes each, compressed and plain."""
    people = [episodes[:8] for episodes in synthetic_human.recording()[:2]]
    folder = tmp_path_factory.mktemp("small")
    return [synthetic_human.write(folder / "a.mat", people, compressed=c).read_bytes() for c in (True, False)]


def assert_same_as_scipy(loaded: dict[str, np.ndarray], data: HumanData) -> None:
    """Compare the tables with what `scipy.io.loadmat` returned, episode by episode."""
    row = 0
    people = loaded["trajectories"].ravel()
    assert len(data.episodes) == sum(person.size for person in people)
    flat = [(p, i, e[0, 0]) for p, person in enumerate(people) for i, e in enumerate(person.ravel())]
    episodes, columns = ({name: values.numpy() for name, values in table.items()} for table in data)
    for number, (p, i, raw) in enumerate(flat):
        fields = {name: np.ravel(raw[name]).astype(float) for name in raw.dtype.names}
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


def test_tables_hold_what_scipy_reads(tmp_path):
    path = synthetic_human.write(tmp_path / "people.mat")
    assert_same_as_scipy(scipy.io.loadmat(path), read(path, checksum=None))


@needs_real
@pytest.mark.slow
def test_tables_of_the_released_file_hold_what_scipy_reads_in_at_most_twenty_times_its_time():
    start = time.process_time()
    loaded = scipy.io.loadmat(REAL)
    scipys = time.process_time() - start
    data = read(REAL)
    assert time.process_time() - start - scipys < 20.0 * scipys
    assert_same_as_scipy(loaded, data)


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
    assert "is a folder, but must be a regular file" in refusal(tmp_path)


def test_default_path_is_that_of_the_environment_variable_or_in_the_cache(monkeypatch, tmp_path):
    monkeypatch.setenv(released_file.PATH_VARIABLE, str(tmp_path / "mine.mat"))
    assert released_file.default_path() == tmp_path / "mine.mat"
    monkeypatch.delenv(released_file.PATH_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert released_file.default_path().name == "BDtrajectory40.mat"


def damaged(data: bytes, case: int, rng: np.random.Generator) -> bytes:
    """Return the bytes cut, with bits flipped, or with foreign bytes in them, by the case's number."""
    if case % 3 == 0:
        return data[: rng.integers(len(data))]
    altered = bytearray(data)
    if case % 3 == 1:
        for place in rng.integers(len(data), size=rng.integers(1, 4)):
            altered[place] ^= 1 << rng.integers(8)
        return bytes(altered)
    at, length = rng.integers(len(data)), rng.integers(1, 64)
    foreign = rng.bytes(length) if case % 2 else bytes([0xFF, 0x7F, 0, 0x0E][case % 4 : case % 4 + 1]) * length
    altered[at : at + (length if case % 4 else 0)] = foreign
    return bytes(altered)


@pytest.mark.parametrize("form", ["compressed", "plain"])
def test_damaged_files_are_refused_or_still_consistent(small, tmp_path, form):
    """300 cases of each form. Where the damaged values are not redundant, the tables are still well formed."""
    data, path = small[form == "plain"], tmp_path / "damaged.mat"
    rng, refused = np.random.default_rng(0), 0
    for case in range(300):
        path.write_bytes(damaged(data, case, rng))
        try:
            episodes, presses = read(path, checksum=None)
        except DataError as error:
            assert "\n" not in str(error)
            refused += 1
            continue
        assert len(presses) == episodes["presses"].sum() and len(episodes) == 16
        assert presses.select("position", "duration", "speed", "distance", "gas").isfinite().all()
        assert ((presses["duration"] > 0) & (presses["duration"] <= 2)).all()
        assert set(episodes["outcome"].tolist()) <= {1, 2, 3, 4}
        assert set(episodes["controller"].tolist()) <= {0, 1} and set(episodes["keymap"].tolist()) <= {1, 2}
        offset = presses["position"] - episodes["centre"][presses["episode"]]
        assert (offset.norm(dim=1) <= 120.01).all()
        assert torch.isnan(presses["next_position"]).all(1).equal(presses["is_final"])
    assert refused > (290 if form == "compressed" else 180)


HEADER = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


def array(kind: int, dims: tuple[int, ...], content: bytes, name: bytes = b"trajectories") -> bytes:
    flags = element(6, struct.pack("<II", kind, 0))
    return element(14, flags + element(5, struct.pack(f"<{len(dims)}i", *dims)) + element(1, name) + content)


def deep(levels: int) -> bytes:
    head = array(1, (1, 1), b"")[8:]
    sizes = [len(head) + (levels - level) * (len(head) + 8) for level in range(levels + 1)]
    return b"".join(struct.pack("<II", 14, size) + head for size in sizes)


def zeros(size: int) -> bytes:
    squeeze = zlib.compressobj()
    body = squeeze.compress(struct.pack("<II", 14, size))
    for _ in range(size >> 20):
        body += squeeze.compress(bytes(1 << 20))
    body += squeeze.flush()
    return struct.pack("<II", 15, len(body)) + body


HOSTILE = {
    "a billion cells": array(1, (1, 2**30), b""),
    "overflowing dimensions": array(1, (2**31 - 1,) * 8, b""),
    "negative dimensions": array(1, (-1, 4), b""),
    "a hundred thousand nested cells": deep(100_000),
    # Packed by the test alone, since that takes seconds.
    "a gigabyte of zeros": functools.partial(zeros, 1 << 30),
    "an element larger than the file": struct.pack("<II", 14, 0xFFFFFFF0) + bytes(64),
    "a matrix of another class": array(6, (1, 1), element(9, bytes(8))),
    "cells of numbers": array(1, (1, 1), array(6, (1, 1), element(9, bytes(8)), b"")),
    "structs without fields": array(1, (1, 1), array(1, (1, 1), array(2, (1, 1), element(5, bytes(4)), b""), b"")),
    "no cells": array(1, (1, 0), b""),
    "another variable": array(6, (1, 1), element(9, bytes(8)), b"x"),
    "a hundred thousand variables": array(6, (1, 1), element(9, bytes(8)), b"x") * 100_000,
    "nothing": b"",
}


def seconds_traced(function: Callable[[], object]) -> float:
    """Return the CPU seconds of a call that takes less than 300 MB."""
    tracemalloc.start()
    start = time.process_time()
    try:
        function()
        taken = time.process_time() - start
        assert tracemalloc.get_traced_memory()[1] < 300e6
    finally:
        tracemalloc.stop()
    return taken


@pytest.fixture(scope="module")
def seconds_of_a_valid_file(tmp_path_factory) -> float:
    path = synthetic_human.write(tmp_path_factory.mktemp("valid") / "people.mat")
    return seconds_traced(lambda: read(path, checksum=None))


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] if "gigabyte" in case else []) for case in HOSTILE]
)
def test_hostile_files_are_refused_in_little_time_and_memory(tmp_path, case, seconds_of_a_valid_file):
    path = tmp_path / "hostile.mat"
    content = HOSTILE[case]
    path.write_bytes(HEADER + (content() if callable(content) else content))
    # The valid file has 31 kB and takes about 0.2 s.
    assert seconds_traced(lambda: refusal(path, checksum=None)) < 10.0 * seconds_of_a_valid_file


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04" * 100, bytes(4096), HEADER[:124] + b"\x01\x00MI" + bytes(64)])
def test_foreign_files_are_refused(tmp_path, data):
    (tmp_path / "foreign.mat").write_bytes(data)
    refusal(tmp_path / "foreign.mat", checksum=None)


WRONG = {
    "R": ("R is not the harbour's radius", lambda v: v - 1),
    "outcome": ("outcome is not 1, 2, 3 or 4", lambda v: v + 4),
    "tank": ("tank is not a number of ticks", lambda v: v + 361),
    "boatchoice": ("boatchoice is not 0 or 1", lambda v: v + 2),
    "incongkm": ("incongkm is not 1 or 2", lambda v: v + 2),
    "boatdir": ("boatdir does not hold the directions", lambda v: -v),
    "center": ("not within 110 px", lambda v: v + 150),
    "SG": ("distance does not follow", lambda v: v + 0.01 * np.eye(4)[1]),
    "distance": ("distance does not follow", lambda v: v + 0.01),
    "gas": ("gas does not follow", lambda v: v - 0.01),
    "velocity": ("velocity does not follow", lambda v: v * 1.01),
    "obs": ("does not follow from its position", lambda v: v + 0.01),
    "actions": ("does not have exactly one key", lambda v: v + 0.01),
    "next_obs": ("", lambda v: v + 0.01),
    "terminals": ("terminals does not mark the final press", lambda v: v[:, ::-1]),
}


@pytest.mark.parametrize("field", WRONG)
def test_a_field_that_breaks_a_rule_is_named_with_its_episode(tmp_path, field):
    people = synthetic_human.recording()
    index = next(i for i, episode in enumerate(people[1]) if episode["gas"].size > 2)
    rule, alter = WRONG[field]
    people[1][index][field] = alter(people[1][index][field])
    message = refusal(synthetic_human.write(tmp_path / "a.mat", people), checksum=None)
    assert f"person 1, episode {index}: " in message and rule in message


def test_missing_fields_and_wrong_sizes_are_named(tmp_path):
    people = synthetic_human.recording()
    del people[0][2]["tank"]
    assert "person 0, episode 2: the fields are" in refusal(
        synthetic_human.write(tmp_path / "a.mat", people), checksum=None
    )
    people = synthetic_human.recording()
    people[0][2]["SG"] = np.zeros((1, 3))
    assert "SG has 3 numbers, but must have 4" in refusal(
        synthetic_human.write(tmp_path / "a.mat", people), checksum=None
    )


def test_people_who_never_pressed_a_key_are_read(tmp_path):
    people = synthetic_human.recording()
    silent = [episode for episodes in people for episode in episodes if not episode["gas"].size]
    episodes, presses = read(synthetic_human.write(tmp_path / "a.mat", [silent]), checksum=None)
    assert len(episodes) == len(silent) > 0 and len(presses) == 0
