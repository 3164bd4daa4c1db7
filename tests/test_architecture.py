"""Who may import whom, and how long things may get."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FILES = {
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
    for file in sorted((ROOT / "hpamdp").rglob("*.py"))
}
LOW, HIGH = "hpamdp.policies.low_level", "hpamdp.policies.high_level"
LEARNERS = [module for module in FILES if module.startswith(f"{LOW}.")]


def imports(module: str) -> Iterator[str]:
    """Yield the dotted names that a module imports, anywhere in it; `from a import b` gives `a.b`."""
    for node in ast.walk(ast.parse(FILES[module].read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def is_in(name: str, package: str) -> bool:
    return f"{name}.".startswith(f"{package}.")


def importers(package: str, inside: str = "hpamdp") -> set[str]:
    return {m for m in FILES if is_in(m, inside) and any(is_in(name, package) for name in imports(m))}


def test_the_modules_are_found():
    assert {"hpamdp.keys", "hpamdp.config", "hpamdp.env.boatdock.physics", f"{LOW}.hyar"} <= set(FILES)
    assert "hpamdp.policies.base" in {name.rpartition(".")[0] for name in imports(f"{LOW}.random")}


@pytest.mark.parametrize("module", ["hpamdp.keys", "hpamdp.env.boatdock.physics"])
def test_the_foundations_import_nothing_of_ours(module):
    assert not [name for name in imports(module) if is_in(name, "hpamdp")]


def test_environments_and_policies_do_not_know_each_other():
    assert not importers("hpamdp.policies", inside="hpamdp.env")
    assert not importers("hpamdp.env", inside="hpamdp.policies")


def test_the_data_knows_the_environments_and_nobody_below_knows_the_data():
    allowed = ("data", "env", "keys", "specs", "reference")
    known = {name for module in FILES if is_in(module, "hpamdp.data") for name in imports(module)}
    assert not [n for n in known if is_in(n, "hpamdp") and not any(is_in(n, f"hpamdp.{room}") for room in allowed)]
    assert not importers("hpamdp.data", inside="hpamdp.env") | importers("hpamdp.data", inside="hpamdp.policies")


def test_the_levels_do_not_know_each_other():
    assert not importers(LOW, inside=HIGH)
    assert not importers(HIGH, inside=LOW)


@pytest.mark.parametrize("learner", LEARNERS)
def test_learners_do_not_know_each_other(learner):
    # A learner of two files has the second named after the first: only pdqn may know a pdqn_model.
    importing = importers(learner, inside=LOW) - {learner}
    assert not {module for module in importing if not learner.startswith(f"{module}_")}


def test_learners_and_selectors_know_neither_the_config_nor_the_agent():
    for forbidden in ("hpamdp.config", "hpamdp.run.train", "hpamdp.run.assemble", "hpamdp.policies.agent"):
        assert not importers(forbidden, inside=LOW) | importers(forbidden, inside=HIGH)


def test_hydra_wandb_and_minari_stay_in_their_rooms():
    assert importers("hydra") <= {"hpamdp.cli", "hpamdp.config", "hpamdp.run.sweep"}
    assert importers("wandb") <= {"hpamdp.run.metrics"}
    assert importers("minari") <= {"hpamdp.data.human.minari"}


def test_the_run_gets_concrete_classes_only_through_build():
    for concrete in (LOW, HIGH, "hpamdp.env.boatdock.environment"):
        assert not importers(concrete) & {"hpamdp.run.train", "hpamdp.run.assemble"}


@pytest.mark.parametrize("file", [ROOT / "run.py", *FILES.values()], ids=lambda file: file.relative_to(ROOT).as_posix())
def test_files_and_functions_stay_short(file):
    source = file.read_text()
    limits = {"run.py": 40, "train.py": 150}
    assert len(source.splitlines()) <= limits.get(file.name, 350)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            body = node.body[1:] if ast.get_docstring(node) else node.body
            length = node.end_lineno - body[0].lineno + 1 if body else 0
            assert length <= 50, f"{node.name} has {length} lines"
