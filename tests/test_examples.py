"""The examples run, import only what they say they need, and do what they promise."""

import ast
import runpy
from pathlib import Path

import pytest

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
