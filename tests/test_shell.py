"""The program as it is started from a shell: words that can be pasted, streams, folders and limits of any kind."""

import os
import resource
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import CONF, forked
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import QuotedString
from omegaconf import OmegaConf

from hpamdp import cli
from hpamdp.files import replacing
from hpamdp.run import train
from hpamdp.search_path import put_working_directory_last
from hpamdp.shell import for_hydra, path_setting, setting

FOLDERS = [
    *("sweep", "outputs/2025-01-31/12-00-00-000001", "lr=0.1,seed=1", "my runs/a", "läufe", "a(b)"),
    *("low.hidden_dims=[32]", "it's", 'a "b"', "$HOME", "${seed}", "\\${seed}", "%d", "back\\slash", "back\\"),
    *("~", "~root/x", "{a: 1}", "a,b,", "two  spaces and one at the end ", "1", "1e5", "null", "-x"),
    *("!important #1; rm -rf x & | > < * ? `ls`", "😀"),
]


def test_a_printed_setting_is_read_as_the_same_text_when_pasted():
    words = [path_setting("resume", Path(folder)) for folder in FOLDERS]
    assert not [word for word in words if "\n" in word] and words[0] == "resume=sweep"
    pasted = subprocess.run(
        ["bash", "-c", f"printf '%s\\0' {' '.join(words)}"], capture_output=True, text=True, check=True
    )
    overrides = OverridesParser.create().parse_overrides(pasted.stdout.split("\0")[:-1])
    for folder, override in zip(FOLDERS, overrides, strict=True):
        value = override.value()
        read = OmegaConf.create({"resume": value.text if isinstance(value, QuotedString) else value}).resume
        assert Path(os.path.expanduser(read)) == Path(folder), override.input_line


def test_a_text_outside_the_grammar_is_printed_as_it_must_be_typed(command):
    for text in ("my runs/lr=0.1,seed=1", "a(b)", "a,b", "it's"):
        for name in ("resume", "low.checkpoint"):
            code, _, err = command(f"{name}={text}")
            assert code == 2 and err.count("\n") == 1, err
            assert setting(name, text) in err, text


@pytest.mark.parametrize(
    ("started_as", "told"), [("run.py", "python run.py"), ("my clone/run.py", "python 'my clone/run.py'")]
)
def test_the_program_is_named_as_it_was_started(command, monkeypatch, capsys, started_as, told):
    monkeypatch.setattr(sys, "argv", [started_as, "--help"])
    cli.main()
    assert f"Usage: {told} [GROUP=CHOICE" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", [started_as, "watch", "--foo"])
    with pytest.raises(SystemExit):
        cli.main()
    assert capsys.readouterr().err == f"unrecognized arguments: --foo; see {told} watch --help\n"


def written_yaml(folder: Path, text: str) -> list[str]:
    """Write an experiment; return the words that choose it."""
    file = folder / "mine/experiment/odd.yaml"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"# @package _global_\n{text}")
    return ["--config-dir", str(folder / "mine"), "experiment=odd", "low=random"]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("defaults:\n  - odd\n", "a yaml file names itself among its defaults"),
        ("seed: 1\nseed: 2\n", "odd.yaml, line 3: found duplicate key seed"),
        ("env:\n\tseed: 1\n", "odd.yaml, line 3: "),
        ("num_envs: ${seed}\nseed: ${num_envs}\n", "seed: "),
    ],
)
def test_an_unreadable_yaml_is_refused_in_one_line(command, tmp_path, text, line):
    code, _, err = command(*written_yaml(tmp_path, text))
    assert code == 2 and err.count("\n") == 1 and line in err


def test_a_setting_with_dashes_is_reported_without_them(command):
    code, _, err = command("--seed=1", "low=hppo")
    assert (code, err) == (2, "--seed=1: settings have no dashes, write seed=1; a wandb sweep ${args_no_hyphens}\n")


def ends_with(folder: Path, words: list[str], out: int, encoding: str, err: Path) -> None:
    """Run the program with this stdout in a process of its own, and end it as the interpreter does."""
    os.chdir(folder)
    sys.stdout = open(os.dup(out), "w", encoding=encoding)  # noqa: SIM115
    sys.stderr = err.open("w")
    sys.argv = ["run.py", *words]
    try:
        cli.main()
    finally:
        sys.stdout.close()
        sys.stderr.close()


def test_a_clone_stays_first_where_python_looks_for_modules(monkeypatch, tmp_path):
    root = str(CONF.parent)
    monkeypatch.setattr(sys, "path", [root, "/packages"])
    monkeypatch.chdir(root)
    put_working_directory_last()
    assert sys.path == [root, "/packages"]
    monkeypatch.setattr(sys, "path", [str(tmp_path), root, "/packages", ""])
    monkeypatch.chdir(tmp_path)
    put_working_directory_last()
    assert sys.path == [root, "/packages", str(tmp_path)]


def of_a_limited_process(folder: Path, limit: int, value: int, err: Path) -> None:
    resource.setrlimit(limit, (value, value))
    ends_with(folder, ["hydra.run.dir=out"], 1, "utf-8", err)


def test_a_limit_of_the_size_of_files_is_a_full_disk(tmp_path, monkeypatch):
    def run(cfg, folder, *_, **__):
        with replacing(folder / "checkpoint.safetensors") as partial:
            partial.write_bytes(bytes(100_000))

    monkeypatch.setattr(train, "run", run)
    (tmp_path / "out").mkdir()
    (tmp_path / "out/checkpoint.safetensors").write_text("the one before")
    err = tmp_path / "err.txt"
    assert forked(of_a_limited_process, tmp_path, resource.RLIMIT_FSIZE, 50_000, err) == 1
    assert err.read_text() == f"{tmp_path / 'out'}: File too large; the run was stopped\n"
    assert (tmp_path / "out/checkpoint.safetensors").read_text() == "the one before"


def test_the_printed_command_continues_the_run_when_pasted(command, tmp_path, monkeypatch):
    folder = "my runs/lr=0.1,seed=[1] it's $5"
    small = ["high=fixed", "low=random", "num_envs=2", "steps_per_batch=2", "eval.layouts=2", "film=false"]
    assert command(*small, "total_frames=4", f"hydra.run.dir={for_hydra(folder)}")[0] == 0
    assert (tmp_path / folder / "checkpoint.safetensors").is_file()
    err = command(*small, "total_frames=8", f"hydra.run.dir={for_hydra(folder)}")[2]
    told = err.partition("continue it with ")[2].partition(", take another")[0]
    code, out, err = command(*shlex.split(told), "total_frames=8", f"hydra.run.dir={for_hydra(folder)}")
    assert code == 0 and "8 frames" in out, err
