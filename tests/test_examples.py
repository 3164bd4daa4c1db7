"""The examples run, import only what they say they need, and do what they promise."""

import ast
import json
import os
import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest
from conftest import CROSSING, forked
from crossing import NUM_CELLS, Crossing, best_values
from torchrl.envs.utils import check_env_specs

from hpamdp import cli

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.stem)
def test_examples_in_plain_torchrl_import_only_our_environments(file):
    modules = [node.module for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.ImportFrom)]
    ours = [module for module in modules if module.startswith("hpamdp")]
    assert ours and all(module.startswith("hpamdp.env.") for module in ours)


@pytest.mark.slow
def test_an_option_policy_in_plain_torchrl_beats_either_boat_alone(capsys):
    scores = runpy.run_path(str(EXAMPLES / "option_policy_plain_torchrl.py"))["main"](10)
    assert list(scores) == ["incongruent", "congruent", "learned"]
    assert scores["learned"] > max(scores["incongruent"], scores["congruent"]) + 0.3
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(scores)


def test_the_command_of_crossing_runs(tmp_path):
    (command,) = re.findall(r"^python -m hpamdp\.cli (.*)$", (CROSSING / "README.md").read_text(), re.MULTILINE)
    short = ["low.warmup_steps=64", "high.warmup_decisions=20", "high.updates_per_decision=0.1"]
    short += ["total_frames=128", "num_envs=8", "eval.every=0", "eval.layouts=4", f"hydra.run.dir={tmp_path}"]

    def run() -> None:
        os.chdir(CROSSING)
        sys.argv = ["hpamdp", *shlex.split(command), *short]
        cli.main()

    assert forked(run) == 0
    assert json.loads((tmp_path / "summary.json").read_text())["finished"]


@pytest.mark.parametrize("problem", ["Offer", "Delivery", "Warehouse", "Tour"])
def test_the_commands_of_the_kinds_of_actions_run(problem, tmp_path):
    folder = EXAMPLES / "spaces"
    commands = re.findall(r"^python -m hpamdp\.cli (.*)$", (folder / "README.md").read_text(), re.MULTILINE)
    (command,) = [each for each in commands if f"shop:{problem} " in each]
    short = ["total_frames=640", "eval.every=0", "eval.layouts=4", "film=false", f"hydra.run.dir={tmp_path}"]

    def run() -> None:
        os.chdir(folder)
        sys.argv = ["hpamdp", *shlex.split(command), *short]
        cli.main()

    assert forked(run) == 0
    assert json.loads((tmp_path / "summary.json").read_text())["finished"]


def test_crossing_keeps_the_contract_and_its_best_values_are_those_by_hand():
    check_env_specs(Crossing(3, start=3.0))
    gamma = 0.9
    every_step, every_third = best_values(gamma, 1), best_values(gamma, 3)
    assert len(every_step) == NUM_CELLS == 25 and every_step[-1] == 0.0
    # Three steps over land and three through water, the last of which pays.
    assert [every_step[0], every_third[0]] == pytest.approx([gamma**5] * 2)
    assert every_step[20] == 1.0
    # A whole step before the water; with a choice at every third step, two slow ones follow before three that swim.
    assert every_step[8] == pytest.approx(gamma**3)
    assert every_third[8] == pytest.approx(gamma**5)
