"""What a run writes is whole or not there, and lies inside its folder, wherever links in it lead."""

import os
import shutil
import socket
import stat

import numpy as np
import pytest
from conftest import compose_config

import hpamdp
from hpamdp.commands import play
from hpamdp.files import kept_in_cache, replacing
from hpamdp.run.folder import locked
from hpamdp.run.train import run

TINY = ["low=hppo", "low.minibatch_size=8", "num_envs=4", "steps_per_batch=2", "eval.layouts=2", "eval.every=0"]
TINY += ["log_every=8"]


def outside_copies(folder, outside):
    """Move every file of a folder outside and leave a soft or hard link in its place; return the bytes of each."""
    outside.mkdir()
    contents = {}
    for i, file in enumerate(sorted(path for path in folder.iterdir() if path.is_file())):
        target = outside / file.name
        contents[target] = file.read_bytes()
        shutil.move(file, target)
        (os.symlink if i % 2 else os.link)(target, file)
    return contents


def test_a_run_never_writes_through_a_link_in_its_folder(tmp_path, with_figures):
    folder = tmp_path / "run"
    words = [*TINY, "total_frames=16", "film=true", "save_best=false"]
    assert run(compose_config(words), folder, words) == 0
    names = {path.name for path in folder.iterdir()}
    assert {
        "checkpoint.safetensors",
        "policy.safetensors",
        "config.yaml",
        "metrics.csv",
        "summary.json",
        "evaluation.npz",
    } < names
    assert {"episodes.gif", "learning_curves.png"} < names
    contents = outside_copies(folder, tmp_path / "outside")
    os.link(tmp_path / "outside/summary.json", folder / ".hpamdp-lock")
    os.symlink(tmp_path / "outside/summary.json", folder / "metrics.csv.previous")
    words = [f"resume={folder}", "total_frames=32", "film=true", "save_best=false"]
    with locked(folder):
        assert run(compose_config(words), folder, words) == 0
    assert all(target.read_bytes() == data for target, data in contents.items())
    assert {path.name for path in folder.iterdir()} == {*names, "metrics.csv.previous"}
    assert not [path for path in folder.iterdir() if path.is_symlink() or path.stat().st_nlink > 1]


def test_an_exported_page_replaces_links(tmp_path):
    (tmp_path / "index.html").write_text("new")
    page = type("Page", (), {"files": {"index.html": tmp_path / "index.html"}})
    (tmp_path / "export").mkdir()
    for name in ("index.html", play.DATA_NAME):
        (tmp_path / f"own-{name}").write_text("own")
        (tmp_path / "export" / name).symlink_to(tmp_path / f"own-{name}")
    play.export(page, {}, tmp_path / "export")
    assert (tmp_path / "export/index.html").read_text() == "new"
    assert all((tmp_path / f"own-{name}").read_text() == "own" for name in ("index.html", play.DATA_NAME))


def test_a_failed_write_leaves_the_old_file_and_nothing_beside_it(tmp_path):
    file = tmp_path / "a.txt"
    file.write_text("old")
    leftover = tmp_path / ".a.txt.00ff.partial.txt"
    leftover.write_text("left by a kill")
    os.utime(leftover, (0.0, 0.0))
    with pytest.raises(OSError, match="full"), replacing(file) as partial:
        partial.write_text("ne")
        raise OSError("full")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", "old")]
    with replacing(file) as partial:
        assert partial.suffix == ".txt"
        partial.write_text("new")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("a.txt", "new")]
    assert file.stat().st_mode & 0o777 == 0o666 & ~_umask()


def test_several_writers_of_one_file_do_not_remove_what_the_others_write(tmp_path):
    file = tmp_path / "a.txt"
    with replacing(file) as outer:
        outer.write_text("outer")
        with replacing(file) as inner:
            inner.write_text("inner")
        assert file.read_text() == "inner"
    assert file.read_text() == "outer"


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def test_a_named_pipe_and_a_socket_are_never_replaced_by_a_file(tmp_path):
    pipe, listening = tmp_path / "pipe.safetensors", tmp_path / "socket.safetensors"
    os.mkfifo(pipe)
    agent = hpamdp.load("hppo_platform")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(listening))
        for path in (pipe, listening):
            with pytest.raises(OSError, match=rf"must be a regular file: '{path}'$"):
                agent.save(path)
    assert stat.S_ISFIFO(pipe.stat().st_mode) and stat.S_ISSOCK(listening.stat().st_mode)
    assert {*tmp_path.iterdir()} == {pipe, listening}


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("nowhere/x.safetensors", "No such file or directory"),
        ("file/x.safetensors", "Not a directory"),
        (".", "is a folder, a pipe or a device, but must be a regular file"),
        ("x" * 300, "File name too long"),
        pytest.param(
            "closed/x.safetensors",
            "Permission denied",
            marks=pytest.mark.skipif(os.geteuid() == 0, reason="root may write"),
        ),
    ],
)
def test_a_path_that_cannot_be_written_is_named_with_the_reason(path, reason, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "closed").mkdir(mode=0o555)
    with pytest.raises(OSError) as error, replacing(tmp_path / path):
        pass
    assert (error.value.filename, error.value.strerror) == (str(tmp_path / path), reason)


def test_an_error_inside_the_block_about_the_new_file_names_the_path(tmp_path):
    with pytest.raises(FileNotFoundError) as error, replacing(tmp_path / "x.safetensors") as partial:
        partial.unlink()
        partial.read_bytes()
    assert error.value.filename == str(tmp_path / "x.safetensors")


def test_an_array_in_the_cache_is_computed_once_and_again_if_its_file_is_broken(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    computed = []

    def compute():
        computed.append(1)
        return np.arange(3)

    for given in (b"one", b"one", b"two"):
        assert kept_in_cache("arrays", given, compute).tolist() == [0, 1, 2]
    assert len(computed) == 2
    for file in (tmp_path / "hpamdp" / "arrays").iterdir():
        file.write_bytes(file.read_bytes()[:-1] + b"\1")
    assert kept_in_cache("arrays", b"one", compute).tolist() == [0, 1, 2]
    assert len(computed) == 3
    monkeypatch.setenv("XDG_CACHE_HOME", os.devnull)
    assert kept_in_cache("arrays", b"one", compute).tolist() == [0, 1, 2]
    assert len(computed) == 4
