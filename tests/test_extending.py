"""The examples of examples/extending run from outside the package, by the commands that their README gives."""

import json
import os
import re
import shlex
import sys
from pathlib import Path

import pytest
import torch
from conftest import forked
from torchrl.envs.utils import check_env_specs

import hpamdp
from hpamdp import cli

FOLDER = Path(__file__).resolve().parent.parent / "examples" / "extending"
COMMANDS = re.findall(r"^python (-m hpamdp\.cli .*)$", (FOLDER / "README.md").read_text(), re.MULTILINE)
# What makes a run short.
SHORT = ["num_envs=8", "steps_per_batch=4", "total_frames=256", "eval.every=128", "eval.layouts=10"]


def run(words: list[str], folder: Path) -> dict:
    """Run `python -m hpamdp.cli ...` in the examples' folder, in a process of its own."""
    assert words[:2] == ["-m", "hpamdp.cli"]
    # Forked, because the imports take longer than the run.
    assert forked(_main, [*words[2:], f"hydra.run.dir={folder}"]) == 0
    return json.loads((folder / "summary.json").read_text())


def _main(words: list[str]) -> None:
    os.chdir(FOLDER)
    sys.argv = ["hpamdp", *words]
    cli.main()


def test_the_readme_has_a_command_for_each_file():
    assert len(COMMANDS) == 6
    for file in FOLDER.glob("*.py"):
        assert any(file.stem in command for command in COMMANDS), file.name


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.split("total_frames")[0][:60])
def test_each_command_of_the_readme_runs(command, tmp_path):
    minibatch = ["low.minibatch_size=16"] if "hppo" in command else []
    summary = run([*shlex.split(command), *SHORT, *minibatch], tmp_path)
    assert summary["finished"] and summary["frames"] == 256


def test_the_selector_of_ones_own_keeps_to_options_that_a_problem_allows(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    from softmax import Softmax

    env = hpamdp.make("office", num_envs=64, chooses_goal=True)
    step = env.reset()
    mask = step["option_mask"] & torch.tensor([True, False, True])
    step.update({"option_mask": mask, "is_decision": torch.ones(64, 1, dtype=torch.bool)})
    selector = Softmax(hpamdp.PAMDPSpecs.from_env(env))
    assert mask.gather(-1, selector.select(step).unsqueeze(-1)).all()


def test_a_run_of_ones_own_classes_is_resumed_by_their_names(tmp_path):
    words = shlex.split(next(command for command in COMMANDS if "reinforce" in command))
    run([*words, *SHORT], tmp_path / "a")
    again = run([*words[:4], f"resume={tmp_path / 'a'}", "total_frames=320"], tmp_path / "b")
    assert (again["env"], again["high"], again["low"], again["frames"]) == ("putting", "none", "reinforce", 320)


def test_the_page_extend_quotes_the_examples_and_their_commands_to_the_letter():
    page = (FOLDER.parent.parent / "docs/extend.md").read_text()
    sources = [file.read_text() for file in FOLDER.glob("*.py")]
    sources += [file.read_text() for file in FOLDER.glob("conf/*/*.yaml")]
    quotes = re.findall(r"^```(?:python|yaml)\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    assert len(quotes) > 5
    assert not [quote for quote in quotes if not any(quote.rstrip() in source for source in sources)]
    assert re.findall(r"^python (-m hpamdp\.cli .*)$", page, re.MULTILINE) == COMMANDS


@pytest.fixture
def putting(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    import putting

    return putting


def test_the_problem_of_ones_own_keeps_the_contract(putting):
    env = putting.PuttingEnv(5, seed=3)
    check_env_specs(env)
    one = env.reset()["observation"]
    half = putting.PuttingEnv(2, seed=3, first_env=3)
    assert torch.equal(half.reset()["observation"], putting.PuttingEnv(5, seed=3).reset()["observation"][3:])
    state = env.env_state()
    again = putting.PuttingEnv(5, seed=3)
    again.set_env_state(state)
    assert torch.equal(again.env_state()["distance"], state["distance"]) and one.shape == (5, 2)


@pytest.mark.slow
def test_the_learner_of_ones_own_learns(tmp_path):
    command = next(command for command in COMMANDS if "reinforce" in command)
    assert run(shlex.split(command), tmp_path)["success"] > 0.9
