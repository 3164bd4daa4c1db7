"""Settings and cards are read without torch, and are those of the real classes."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from conftest import CONF, choices

from hpamdp.config.components import (
    CALLBACK,
    GROUPS,
    card_named,
    check_base_class,
    load_class,
    name_of_passed,
    takes_settings_model,
)
from hpamdp.config.errors import ConfigError
from hpamdp.policies.low_level.random import Random
from hpamdp.run.callbacks import Callback
from hpamdp.run.train import check_callbacks

CHOICES = [(group, name) for group in (*GROUPS, CALLBACK) for name in choices(group)]
TARGETS = {yaml.safe_load((CONF / group / f"{name}.yaml").read_text())["_target_"] for group, name in CHOICES} - {None}


def python(*words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(CONF.parent)}
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, cwd=cwd, env=environment)


def test_the_cards_of_all_classes_are_read_without_torch():
    # As on the command line: without it, `import hpamdp` registers the ids of Gymnasium.
    program = f"""
import sys
sys.argv = ["hpamdp"]
from hpamdp.config.components import card_named
assert all(card_named(target) for target in {sorted(TARGETS)})
slow = {{"torch", "torchrl", "tensordict", "gymnasium", "numba", "scipy", "matplotlib"}}
assert not slow & {{*sys.modules}}, slow & {{*sys.modules}}
"""
    done = python("-c", program)
    assert done.returncode == 0, done.stderr


def test_each_class_has_its_card_and_the_settings_on_it():
    for target in TARGETS:
        cls, card = load_class(target), card_named(target)
        assert cls.card is card, target
        assert card.options is (cls.Options if takes_settings_model(cls) else None), target


def test_a_class_of_a_user_that_declares_something_outside_its_card_is_refused():
    class Old(Random):
        takes_pictures = True

    class OldCallback(Callback):
        needs_evaluations = True

    with pytest.raises(ConfigError, match=r"Old: takes_pictures .* write card = LearnerCard\(takes_pictures=\.\.\.\)"):
        check_base_class("low", "old", name_of_passed(Old))
    with pytest.raises(ConfigError, match=r"OldCallback: needs_evaluations .* write card = CallbackCard\("):
        check_callbacks([OldCallback()])


MISTAKES = (
    "low.gamma=hi",
    "low.gama=1",
    "total_frames=-1",
    "high=none",
    "env=goal high=ucb",
    "num_envs=3 collector=multi",
    "env=circuit env.task=bell env.target_number=1 high=none",
)


@pytest.fixture(scope="module")
def refusals(tmp_path_factory) -> dict[str, list]:
    """The exit code and stderr of each mistake and of help, and whether torch or tensordict was imported by then."""
    program = f"""
import contextlib, io, json, sys
from hpamdp.cli import main
refusals = {{}}
for words in {("--help", *MISTAKES)!r}:
    sys.argv, code = ["hpamdp", *words.split()], 0
    with contextlib.redirect_stderr(io.StringIO()) as err, contextlib.redirect_stdout(io.StringIO()):
        try:
            main()
        except SystemExit as end:
            code = end.code
    refusals[words] = code, err.getvalue(), bool({{"torch", "tensordict"}} & {{*sys.modules}})
print(json.dumps(refusals))
"""
    done = python("-c", program, cwd=tmp_path_factory.mktemp("refusals"))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("words", MISTAKES)
def test_a_wrong_setting_is_refused_before_torch_is_imported(words, refusals):
    code, err, is_imported = refusals[words]
    assert (code, err.count("\n"), is_imported) == (2, 1, False), err


def test_help_does_not_wait_for_torch(refusals):
    assert refusals["--help"] == [0, "", False]


def test_classes_of_a_user_that_groups_and_values_name_are_imported(tmp_path):
    for group, name in (("low", "Mine"), ("low", "Own"), (CALLBACK, "Weight")):
        file = tmp_path / "conf" / group / f"{name.lower()}.yaml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"_target_: mine.{name}\n" + ("budget: {eval_every: 0}\n" if group == "low" else ""))
    (tmp_path / "mine.py").write_text(
        "from abc import ABC\nimport numpy as np\nfrom hpamdp.policies.low_level.random import Random\n"
        "from hpamdp.run.callbacks import Callback\n\n\n"
        "class Mine(Random, ABC):\n    def __init__(self, specs, *, weight: float = float(np.sqrt(4.0))):\n"
        "        super().__init__(specs)\n        self.weight = weight\n\n\n"
        "class Own(Random):\n    pass\n\n\n"
        "class Weight(Callback):\n    def __init__(self, weight: float = float(np.sqrt(9.0))):\n"
        "        self.weight = weight\n\n    def metrics(self, trainer):\n        return {'weight': self.weight}\n"
    )
    words = ["--config-dir", "conf", "low=mine", "env=platform", "high=uniform", "+env.grouping=default"]
    words += ["+low.per_option={jump: own}", "callbacks=[weight]"]
    short = ["total_frames=64", "num_envs=4", "steps_per_batch=8", "eval.layouts=4", "film=false"]
    # First the help, which ends by `SystemExit`, then the run.
    (tmp_path / "go.py").write_text(
        "import contextlib, sys\nfrom hpamdp.cli import main\nsys.path.insert(0, '.')\n"
        "words, sys.argv = sys.argv, [*sys.argv, '--help']\nwith contextlib.suppress(SystemExit):\n    main()\n"
        "sys.argv = words\nmain()\n"
    )
    done = python("go.py", *words, *short, "hydra.run.dir=out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert yaml.safe_load((tmp_path / "out/config.yaml").read_text())["low"]["weight"] == 2.0
    with (tmp_path / "out/metrics.csv").open() as file:
        assert {row["own/weight"] for row in csv.DictReader(file)} == {"3.0"}
    assert "Settings of low=mine\n  low.weight=2.0\n" in done.stdout
