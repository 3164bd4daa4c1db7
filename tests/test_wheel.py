"""The built wheel is complete: commands and Python code work in an empty folder, without the repository."""

from __future__ import annotations

import email
import os
import re
import signal
import subprocess
import sys
import urllib.request
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

import hpamdp

ROOT = Path(__file__).resolve().parent.parent
AGENTS = sorted(folder.name for folder in (ROOT / "agents").iterdir() if folder.is_dir())

pytestmark = pytest.mark.slow

SNIPPET = """
import hpamdp
agent = hpamdp.load("linucb_hppo")
env = hpamdp.make_gymnasium("boatdock")
observation, info = env.reset(seed=0)
done = False
while not done:
    observation, reward, terminated, truncated, info = env.step(agent.act(observation))
    done = terminated or truncated
print(info["score"])
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (file,) = folder.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def site(wheel) -> Path:
    """Return a folder in which the wheel alone is installed."""
    folder = wheel.parent / "site"
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(folder), str(wheel)]
    subprocess.run(install, check=True, capture_output=True)
    return folder


@pytest.fixture
def installed(site, tmp_path, monkeypatch) -> Mapping[str, str]:
    """Enter an empty folder, and return the variables of processes that find the installed package first."""
    monkeypatch.chdir(tmp_path)
    return {**os.environ, "PYTHONPATH": str(site)}


def run(words: list[str], installed: Mapping[str, str]) -> str:
    """Run a program to its end, and return its stdout."""
    done = subprocess.run([sys.executable, *words], env=installed, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_holds_yaml_files_agents_the_page_and_types(wheel):
    names = {*zipfile.ZipFile(wheel).namelist()}
    files = [file for folder in ("hpamdp", "conf", "agents") for file in (ROOT / folder).rglob("*") if file.is_file()]
    for file in files:
        if "__pycache__" not in file.parts:
            name = file.relative_to(ROOT).as_posix()
            assert (name if name.startswith("hpamdp/") else f"hpamdp/{name}") in names
    assert {"hpamdp/py.typed", "hpamdp/__init__.pyi", "hpamdp/conf/config.yaml"} <= names
    assert {f"hpamdp/agents/{name}/policy.safetensors" for name in AGENTS} <= names


def test_its_metadata_are_complete(wheel):
    archive = zipfile.ZipFile(wheel)
    (name,) = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
    metadata = email.message_from_bytes(archive.read(name))
    assert metadata["Name"] == "hpamdp" and metadata["Version"] == hpamdp.__version__
    assert metadata["Author"] == "The hpamdp developers"
    assert metadata["License-Expression"] == "MIT" and metadata["License-File"] == "LICENSE"
    assert "parameterised actions" in metadata["Keywords"]
    assert "Typing :: Typed" in metadata.get_all("Classifier")
    assert metadata["Description-Content-Type"] == "text/markdown"
    assert metadata.get_payload().startswith("# hpamdp")
    assert "Project-URL" not in metadata and "Home-page" not in metadata


def test_nothing_of_the_repository_is_used(site, installed):
    code = "import hpamdp; from hpamdp.config.compose import conf_dir, package_dir; "
    code += "print(hpamdp.__file__, conf_dir(), package_dir('agents'))"
    assert all(Path(path).is_relative_to(site) for path in run(["-c", code], installed).split())


@pytest.mark.parametrize(
    ("words", "written"),
    [
        (["watch", "linucb_hppo", "--episodes=1"], "episodes.gif"),
        (["watch", "hppo_platform", "--to", "a.gif", "--episodes=1"], "a.gif"),
        (["play", "--export", "site", "--agent", "linucb_hppo"], "site/index.html"),
        (["mode=eval", "checkpoint=hppo_platform", "eval.layouts=4", "hydra.run.dir=scored"], "scored/summary.json"),
        (["--help"], None),
        (["--version"], None),
    ],
)
def test_a_command_works_in_an_empty_folder(words, written, installed, site):
    out = run([str(site / "bin/hpamdp"), *words], installed)
    assert written is None or Path(written).is_file()
    assert written is not None or "hpamdp" in out


def test_an_agent_plays_in_gymnasium(installed):
    assert float(run(["-c", SNIPPET], installed)) > 2.0


def test_play_serves_its_page_its_scripts_and_the_agents(installed, site):
    command = [sys.executable, str(site / "bin/hpamdp"), "play", "--no-browser", "--port", "0"]
    server = subprocess.Popen(command, env=installed, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        address = re.search(r"http://[\w.:]+", server.stdout.readline()).group()
        page = fetched(address)
        parts = re.findall(r'(?:src|href)="([\w.]+\.(?:js|css))"', page)
        assert {"game.js", "boats.js", "physics.js", "network.js", "data.js", "style.css"} <= {*parts}
        texts = {part: fetched(f"{address}/{part}") for part in parts}
        assert all(texts.values()) and '"linucb_hppo"' in texts["data.js"]
        server.send_signal(signal.SIGINT)
        assert server.wait(20) == 0
    finally:
        server.kill()
        server.wait()


def fetched(address: str) -> str:
    with urllib.request.urlopen(address, timeout=10) as answer:
        return answer.read().decode()
