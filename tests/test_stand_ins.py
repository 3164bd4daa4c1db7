"""Classes read with stand-ins for slow libraries tell the same as the real ones, and leave nothing behind."""

import csv
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from class_descriptions import described
from conftest import CONF, choices

from hpamdp.config.components import CALLBACK, GROUPS, load_class

FILES = [(group, name) for group in (*GROUPS, CALLBACK) for name in choices(group)]


def target_of(group: str, name: str) -> str | None:
    return yaml.safe_load((CONF / group / f"{name}.yaml").read_text())["_target_"]


def python(*words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(CONF.parent)}
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, cwd=cwd, env=environment)


@pytest.fixture(scope="module")
def quick():
    """What all classes tell in a process with stand-ins, and which modules it has left."""
    targets = [(target_of(group, name), group) for group, name in FILES]
    script = str(Path(__file__).with_name("class_descriptions.py"))
    done = python(script, json.dumps([each for each in targets if each[0] is not None]))
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize(("group", "name"), FILES)
def test_a_class_read_with_stand_ins_has_the_settings_and_facts_of_the_real_one(group, name, quick):
    target = target_of(group, name)
    if target is not None:
        assert quick["described"][target] == json.loads(json.dumps(described(load_class(target), group)))


def test_modules_with_stand_ins_are_not_seen_afterwards(quick):
    assert quick["left"] == []


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
    """The exit code and stderr of each mistake, and whether torch or tensordict was imported by then."""
    program = f"""
import contextlib, io, json, sys
from hpamdp.cli import main
refusals = {{}}
for words in {MISTAKES!r}:
    sys.argv, code = ["hpamdp", *words.split()], 0
    with contextlib.redirect_stderr(io.StringIO()) as err:
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


def test_classes_of_a_user_that_groups_and_values_name_are_imported_without_stand_ins(tmp_path):
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
    run = "import sys\nfrom hpamdp.cli import main\nsys.path.insert(0, '.')\nmain()\n"
    (tmp_path / "go.py").write_text(run)
    done = python("go.py", *words, *short, "hydra.run.dir=out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert yaml.safe_load((tmp_path / "out/config.yaml").read_text())["low"]["weight"] == 2.0
    with (tmp_path / "out/metrics.csv").open() as file:
        assert {row["own/weight"] for row in csv.DictReader(file)} == {"3.0"}
    assert "low=mine has the settings weight" in python("go.py", *words, "--help", cwd=tmp_path).stdout
