"""Yaml files of one's own: found through folders that one names, or, with trust, through those that a run names."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import hpamdp
from hpamdp.run import checkpoint

TINY = {"total_frames": 512, "num_envs": 32, "steps_per_batch": 8, "eval.layouts": 4, "film": False}
MODULE = "tossing"  # its import leaves a mark
CODE = """
from pathlib import Path
from hpamdp.env.platform.environment import PlatformEnv

Path(__file__).with_name("imported").touch()

class TossingEnv(PlatformEnv):
    pass
"""
BUDGET = "budget: {num_envs: 16, steps_per_batch: 4, total_frames: 1024, eval_every: 0}\n"
WATCH = ("--episodes=1", "--size=40", "--fps=5")


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Iterator[Path]:
    """Return a folder with a problem of one's own, its yaml file in `own/`, and a run on it in `run/`."""
    folder = tmp_path_factory.mktemp("home")
    (folder / "own/env").mkdir(parents=True)
    (folder / "own/env/tossing.yaml").write_text(f"_target_: {MODULE}.TossingEnv\n")
    (folder / f"{MODULE}.py").write_text(CODE)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        hpamdp.train("tossing", low="hppo", folder=folder / "run", config_dirs=[folder / "own"], progress=False, **TINY)
        yield folder
    sys.modules.pop(MODULE, None)


@pytest.fixture
def unread(home) -> Iterator[None]:
    """Assert that the test reads none of the problem's own files: neither its class nor its yaml."""
    (home / "imported").unlink(missing_ok=True)
    sys.modules.pop(MODULE, None)
    yaml = home / "own/env/tossing.yaml"
    text = yaml.read_text()
    yaml.write_text("_target_: [of, a, reader")  # any reader would fail here
    yield
    yaml.write_text(text)
    assert not (home / "imported").exists()


def words_of(way: str, home: Path, to: str) -> list[str]:
    """Return a command that opens the run, and writes to the folder `to` what it writes."""
    run = str(home / "run")
    return {
        "watch": ["watch", run, *WATCH],
        "score": ["mode=eval", f"checkpoint={run}", "eval.layouts=4", f"hydra.run.dir={to}"],
        "resume": [f"resume={run}", "total_frames=1024", f"hydra.run.dir={to}"],
    }[way]


def test_a_run_remembers_its_folders_in_both_of_its_files(home):
    for name in ("checkpoint.safetensors", "policy.safetensors"):
        assert checkpoint.progress_of(home / "run" / name)["config_dirs"] == [str(home / "own")]


@pytest.mark.parametrize(("way", "permission"), [("watch", "folder"), ("score", "trust")])
def test_a_run_on_a_problem_of_ones_own_is_opened_from_the_shell(way, permission, home, command):
    words = words_of(way, home, "opened")
    flags = ["--config-dir", str(home / "own")]
    if permission == "trust":
        words.append("trust=true")
    else:
        words = [words[0], *flags, *words[1:]] if way == "watch" else [*flags, *words]
    code, _, err = command(*words)
    assert code == 0, err


@pytest.mark.parametrize("permission", [{"config_dirs": ["own"]}, {"trust": True}], ids=["folder", "trust"])
def test_a_run_on_a_problem_of_ones_own_is_opened_from_python(permission, home, monkeypatch):
    monkeypatch.chdir(home)
    agent = hpamdp.load("run", **permission)
    assert agent.evaluate(episodes=3)["steps"] > 0
    more = hpamdp.train(resume="run", progress=False, total_frames=1024, **permission)
    assert more.history[-1]["frames"] == 1024


@pytest.mark.parametrize("way", ["score", "resume"])
def test_without_trust_one_line_names_the_folders_of_a_run_and_nothing_in_them_is_read(way, home, unread, command):
    code, _, err = command(*words_of(way, home, "refused"))
    assert code == 2
    assert err.count("\n") == 1 and "env/tossing, which is not there" in err
    assert str(home / "own") in err and "trust=true" in err


@pytest.mark.parametrize("file", ["run", "run/policy.safetensors"])
def test_python_reads_no_folder_of_a_file_without_trust(file, home, unread):
    with pytest.raises(hpamdp.ConfigError, match="trust=true") as raised:
        hpamdp.load(home / file)
    assert str(home / "own") in str(raised.value) and "\n" not in str(raised.value)
    with pytest.raises(hpamdp.ConfigError, match="trust=true"):
        hpamdp.train(resume=str(home / file), total_frames=1024)


def test_play_reads_no_folder_of_an_agents_file_without_trust(home, unread, command):
    code, _, err = command("play", "--agent", str(home / "run"), "--export", "site")
    assert code == 2 and str(home / "own") in err and not Path("site").exists()


def test_a_folder_of_a_file_comes_after_the_folders_that_one_names(home, tmp_path, command):
    (tmp_path / "other/env").mkdir(parents=True)
    (tmp_path / "other/env/tossing.yaml").write_text("_target_: hpamdp.env.platform.environment.PlatformEnv\n")
    (home / "imported").unlink(missing_ok=True)
    sys.modules.pop(MODULE, None)
    code, _, err = command("watch", str(home / "run"), *WATCH, "--config-dir", str(tmp_path / "other"), "trust=true")
    assert code == 0, err
    assert not (home / "imported").exists()


def test_several_folders_are_searched(home, tmp_path, command):
    (tmp_path / "second/low").mkdir(parents=True)
    (tmp_path / "second/low/quick.yaml").write_text("_target_: hpamdp.policies.low_level.random.Random\n" + BUDGET)
    folders = ["--config-dir", str(home / "own"), "-cd", str(tmp_path / "second")]
    code, _, err = command("watch", *folders, "env=tossing", "high=none", "low=quick", *WATCH)
    assert code == 0, err


@pytest.mark.parametrize(
    ("name", "words", "said"),
    [
        ("watch", ["--config-dir", "nowhere"], "--config-dir: there is no folder nowhere"),
        ("play", ["--config-dir", ".", "hydra.searchpath=[.]"], "--config-dir and hydra.searchpath: give all folders"),
    ],
)
def test_a_wrong_folder_is_refused_in_one_line(name, words, said, command):
    code, _, err = command(name, "env=platform", *words)
    assert (code, err.count("\n")) == (2, 1) and said in err


def test_a_page_of_ones_own_problem_is_found_through_its_folder(tmp_path, command):
    (tmp_path / "own/env").mkdir(parents=True)
    (tmp_path / "own/env/port.yaml").write_text("_target_: hpamdp.env.boatdock.environment.BoatDockEnv\n")
    words = ["--config-dir", str(tmp_path / "own"), "env=port", "--agent", "none", "--export", "site"]
    code, _, err = command("play", *words)
    assert code == 0 and (tmp_path / "site/index.html").is_file(), err
