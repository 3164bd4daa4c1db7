"""`python -m hpamdp.data.human`: what it prints, what it writes, and its errors."""

from __future__ import annotations

import csv
import hashlib
import json
import re
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import synthetic_human
from tensordict import TensorDict

from hpamdp.data import DataError
from hpamdp.data.human import cli
from hpamdp.data.human.dataset import HumanExperienceReplay
from hpamdp.data.human.demonstrations import HumanDemonstrations
from hpamdp.data.human.download import download
from hpamdp.data.human.released_file import read
from hpamdp.data.human.transitions import transitions
from hpamdp.env.boatdock.environment import BoatDockEnv


def printed(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run the command line, which must succeed, and return its stdout."""
    assert cli.main([str(a) for a in arguments]) == 0
    output = capsys.readouterr()
    assert not output.err
    return output.out


def error_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Run the command line, which must fail in one line, and return that line."""
    try:
        code = cli.main([str(a) for a in arguments])
    except SystemExit as end:
        code = end.code
    output = capsys.readouterr()
    assert code == 2 and output.err.count("\n") == 1
    return output.err


def test_check_and_summary_print_what_a_file_holds(capsys, people_file):
    output = printed(capsys, "check", people_file, "--any-file")
    assert "3 people, 210 episodes" in output and "The boat may still have been gliding" in output
    output = printed(capsys, "summary", people_file, "--any-file")
    assert re.search(r"^all +210 ", output, re.MULTILINE)
    figures = json.loads(printed(capsys, "summary", people_file, "--any-file", "--json"))
    assert figures["all"]["episodes"] == 210 and len(figures["person"]) == 3


def test_check_and_summary_of_the_released_file_print_its_known_figures(capsys, people, monkeypatch):
    monkeypatch.setattr(cli, "read", lambda *_, **__: people)
    output = printed(capsys, "check")
    for line in (
        "40 people, 14400 episodes, 46757 presses",
        "without a press 15, with a single press 1823, completely logged 675",
        "harbour at [640, 512]: 20 people; harbour at [672, 504]: 20 people",
        "key map 1: 36 people; key map 2: 4 people",
        "94.6% of 204 single presses",
        "98.1% of 427",
    ):
        assert line in output
    output = printed(capsys, "summary")
    for name, score, success in (
        ("all", "1.970", "86.0%"),
        ("congruent", "2.012", "86.5%"),
        ("incongruent", "1.912", "85.4%"),
        ("episodes 301 to 360", "2.241", "90.0%"),
        (r"best person \(11\)", "3.021", "98.9%"),
    ):
        assert re.search(rf"^{name} +\d+ +{score} +{success}", output, re.MULTILINE), name
    assert "0-10: 0.788, 10-20: 0.741, 20-30: 0.654, 30-40: 0.502, 40-50: 0.427, 50-60: 0.370" in output


def without_presses(folder: Path) -> Path:
    people = synthetic_human.recording()
    episodes = [episode for person in people for episode in person if np.size(episode["gas"]) == 0]
    return synthetic_human.write(folder / "still.mat", [episodes[:3]])


def test_a_recording_without_a_press_is_checked_and_summarised_and_gives_no_transitions(capsys, tmp_path):
    path = without_presses(tmp_path)
    assert printed(capsys, "check", path, "--any-file").endswith("the episodes have no logged press\n")
    assert json.loads(printed(capsys, "summary", path, "--any-file", "--json"))["all"]["presses"] == 0.0
    printed(capsys, "export", path, "--any-file", "--format", "csv", "--to", tmp_path / "tables")
    error = error_of(capsys, "export", path, "--any-file", "--format", "memmap", "--to", tmp_path / "rows")
    assert error == "the episodes have no logged press\n"
    with pytest.raises(DataError, match=r"^the episodes have no logged press$"):
        HumanExperienceReplay(4, path=path, checksum=None)
    for rest_to_rest in (True, False):
        with pytest.raises(DataError, match=r"^the episodes have no logged press$"):
            HumanDemonstrations(BoatDockEnv(1), path=str(path), checksum=None, rest_to_rest=rest_to_rest)


@pytest.mark.parametrize(
    ("form", "given", "said"),
    [
        ("csv", ["--reward", "sparse", "--observation", "pixels"], "--reward sparse, --observation pixels: no effect"),
        ("memmap", ["--one-frame"], "--one-frame: no effect on transitions, which always have one frame"),
    ],
)
def test_options_that_an_export_would_ignore_are_refused(capsys, people_file, tmp_path, form, given, said):
    to = tmp_path / "out"
    assert said in error_of(capsys, "export", people_file, "--any-file", "--format", form, "--to", to, *given)
    assert not to.exists()


@pytest.mark.parametrize(
    ("arguments", "message"), [(["check", "none.mat"], "there is no such file"), (["download"], "required: --url")]
)
def test_usage_errors_are_one_line(capsys, arguments, message):
    assert message in error_of(capsys, *arguments)


def test_an_altered_file_is_refused_in_one_line(capsys, people_file):
    assert "truncated, altered or another file" in error_of(capsys, "summary", people_file)


def test_csv_and_npz_hold_both_tables(capsys, people_file, tmp_path):
    data = read(people_file, checksum=None)
    printed(capsys, "export", people_file, "--any-file", "--format", "csv", "--to", tmp_path / "tables")
    printed(capsys, "export", people_file, "--any-file", "--format", "npz", "--to", tmp_path / "tables.npz")
    arrays = np.load(tmp_path / "tables.npz")
    for name, table in data._asdict().items():
        rows = list(csv.DictReader((tmp_path / "tables" / f"{name}.csv").open()))
        for column, values in table.items():
            assert np.array_equal(arrays[f"{name}/{column}"], values.numpy(), equal_nan=values.is_floating_point())
            parts = [column] if values.ndim == 1 else [f"{column}_x", f"{column}_y"]
            written = np.array([[row[part] or "nan" for part in parts] for row in rows], np.float32)
            assert np.array_equal(written.reshape(values.shape), values.numpy().astype(np.float32), equal_nan=True)


def test_memmap_holds_the_selected_transitions(capsys, people_file, tmp_path):
    wanted = ("--complete", "--reward", "sparse", "--observation", "pixels")
    printed(capsys, "export", people_file, "--any-file", "--format", "memmap", "--to", tmp_path / "batch", *wanted)
    data = read(people_file, checksum=None, one_frame=True)
    kept = data.episodes["complete"][data.presses["episode"]]
    batch = transitions(data, reward="sparse", observation="pixels")[kept]
    written = TensorDict.load_memmap(tmp_path / "batch")
    assert written["observation"].equal(batch["observation"]) and written["next"]["reward"].equal(
        batch["next"]["reward"]
    )


def test_exports_overwrite_nothing_and_leave_nothing_behind(capsys, people_file, tmp_path, monkeypatch):
    target = tmp_path / "tables.npz"
    target.write_text("mine")
    assert "exists" in error_of(capsys, "export", people_file, "--any-file", "--format", "npz", "--to", target)
    assert target.read_text() == "mine"
    (tmp_path / "full").mkdir()

    def fail(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", fail)
    to = tmp_path / "full" / "tables.npz"
    assert "No space left" in error_of(capsys, "export", people_file, "--any-file", "--format", "npz", "--to", to)
    assert not list((tmp_path / "full").iterdir())
    assert "best_people=4" in error_of(
        capsys, "export", people_file, "--any-file", "--format", "npz", "--to", to, "--best-people", 4
    )


@pytest.fixture
def served(tmp_path_factory, monkeypatch) -> Iterator[tuple[str, bytes]]:
    """The address of a file, and what it holds."""
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)
    folder, body = tmp_path_factory.mktemp("served"), np.random.default_rng(0).bytes(300_000)
    (folder / "people.mat").write_bytes(body)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=folder)) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}/people.mat", body
        server.shutdown()
        thread.join()


def test_a_download_is_kept_and_not_fetched_again(served, tmp_path):
    address, body = served
    target, checksum = tmp_path / "cache" / "people.mat", hashlib.sha256(body).hexdigest()
    assert download(address, target, checksum=checksum) == target
    assert target.read_bytes() == body and list(target.parent.iterdir()) == [target]
    assert download("http://127.0.0.1:1/nowhere", target, checksum=checksum) == target


def test_a_download_of_another_file_is_thrown_away(served, tmp_path, capfd):
    assert cli.main(["download", "--url", served[0], "--to", str(tmp_path / "people.mat")]) == 2
    assert "does not match the known hash" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())
