"""Who may import whom, and which words generic code may know."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FILES = {
    ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file
    for file in sorted((ROOT / "hpamdp").rglob("*.py"))
}
LOW, HIGH = "hpamdp.policies.low_level", "hpamdp.policies.high_level"
LEARNERS = [module for module in FILES if module.startswith(f"{LOW}.") and module != f"{LOW}.options"]
TORCH = ("torch", "torchrl", "tensordict")
# The rooms that know boats; everything else is generic.
BOATS = ("hpamdp.env.boatdock", "hpamdp.env.boatdock_released", "hpamdp.env.boatdock_unseen", "hpamdp.data.human")
BOAT_WORDS = re.compile(
    r"boat|(\b|_)press(?!ure)|harbou?r|\bdock|_dock|controller|congruent|\bfuel|_fuel", re.IGNORECASE
)


@cache
def imports(module: str) -> list[str]:
    """Return the dotted names that a module imports, anywhere in it; `from a import b` gives `a.b`."""
    names = []
    for node in ast.walk(ast.parse(FILES[module].read_text())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} imports relatively"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


@cache
def loaded_with(module: str) -> frozenset[str]:
    """Return the dotted names that importing a module imports, by itself or through others of ours."""
    names, waiting = set[str](), [module]
    while waiting:
        for name in imported_at_once(waiting.pop()) - names:
            names.add(name)
            parts = name.split(".")
            # Importing a.b.c also imports a and a.b.
            waiting += [one for i in range(len(parts)) if (one := ".".join(parts[: i + 1])) in FILES]
    return frozenset(names)


@cache
def imported_at_once(module: str) -> set[str]:
    """Return what a module imports when it is imported itself, so neither within functions nor for types alone."""
    names, waiting = set[str](), list[ast.AST](ast.parse(FILES[module].read_text()).body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            waiting += node.orelse
        elif not isinstance(node, ast.FunctionDef | ast.Lambda):
            waiting += ast.iter_child_nodes(node)
    return names


def is_in(name: str, package: str) -> bool:
    return f"{name}.".startswith(f"{package}.")


def importers(package: str, inside: str = "hpamdp") -> set[str]:
    return {m for m in FILES if is_in(m, inside) and any(is_in(name, package) for name in imports(m))}


def test_the_foundations_import_nothing_of_ours():
    for module in ("hpamdp.keys", "hpamdp.messages", "hpamdp.files", "hpamdp.env.rng_streams"):
        assert not [name for name in imports(module) if is_in(name, "hpamdp")], module


def test_the_physics_imports_only_the_constants_of_the_task():
    ours = [name for name in imports("hpamdp.env.boatdock.physics") if is_in(name, "hpamdp")]
    assert ours and all(is_in(name, "hpamdp.env.boatdock.task") for name in ours)


def test_what_a_boat_for_gymnasium_runs_through_imports_no_torch():
    for module in ("task", "layouts", "kernel", "numpy_boats", "gymnasium_adapter"):
        loaded = loaded_with(f"hpamdp.env.boatdock.{module}")
        assert not [name for name in loaded if any(is_in(name, library) for library in TORCH)], module


def test_settings_and_cards_import_no_slow_library():
    slow = (*TORCH, "numba", "scipy", "matplotlib")
    modules = [module for module in FILES if module.endswith(("_options", ".options"))]
    assert f"{LOW}.hppo_options" in modules and "hpamdp.env.platform.options" in modules
    for module in modules:
        assert not [name for name in loaded_with(module) if any(is_in(name, library) for library in slow)], module


# The table of Gymnasium ids names all problems.
GENERIC = [module for module in FILES if not any(is_in(module, room) for room in (*BOATS, "hpamdp.env.registration"))]


def test_generic_code_has_never_heard_of_a_boat():
    offenders = {module for room in BOATS for module in importers(room)} & {*GENERIC}
    for module in GENERIC:
        lines = enumerate(FILES[module].read_text().splitlines(), 1)
        offenders |= {f"{module}:{number}: {line.strip()}" for number, line in lines if BOAT_WORDS.search(line)}
    assert not offenders


def test_environments_and_policies_do_not_know_each_other():
    assert not importers("hpamdp.policies", inside="hpamdp.env")
    assert not importers("hpamdp.env", inside="hpamdp.policies")


def test_a_problem_knows_no_other_but_the_other_boats_the_boats_and_those_on_gymnasium_gymnasium():
    allowed = {
        "boatdock": {"boatdock_released", "boatdock_unseen"},
        "gymnasium": {"lunar_lander", "primitives", "rddl", "traffic"},
    }
    rooms = {module.split(".")[2] for module in FILES if is_in(module, "hpamdp.env") and module.count(".") == 3}
    assert {"boatdock", "boatdock_released", "gymnasium", "platform"} <= rooms
    for room in rooms:
        knowing = {name.split(".")[2] for name in importers(f"hpamdp.env.{room}", "hpamdp.env") if name.count(".") == 3}
        assert knowing <= {room} | allowed.get(room, set())


def test_the_data_knows_the_environments_and_nobody_below_knows_the_data():
    allowed = ("cards", "data", "devices", "env", "files", "json_lines", "keys", "messages", "settings", "specs")
    known = {name for module in FILES if is_in(module, "hpamdp.data") for name in imports(module)}
    assert not [n for n in known if is_in(n, "hpamdp") and not any(is_in(n, f"hpamdp.{room}") for room in allowed)]
    assert not importers("hpamdp.data", inside="hpamdp.env") | importers("hpamdp.data", inside="hpamdp.policies")


def test_no_rooms_know_each_other_in_a_circle_also_within_functions():
    rooms = {module.split(".")[1] for module in FILES if module.count(".") > 1}
    assert {"api", "config", "env", "policies", "run"} <= rooms
    knows = {one: {room for room in rooms - {one} if importers(f"hpamdp.{room}", f"hpamdp.{one}")} for one in rooms}
    while free := [room for room, known in knows.items() if not known & knows.keys()]:
        for room in free:
            del knows[room]
    assert not knows


def test_what_every_room_may_use_knows_no_room_also_within_functions():
    doors = {"hpamdp.__main__", "hpamdp.cli"}
    below = {module for module in FILES if module.count(".") == 1 and FILES[module].name != "__init__.py"} - doors
    assert {"hpamdp.keys", "hpamdp.specs"} <= below
    known = {name for module in below for name in imports(module) if is_in(name, "hpamdp")}
    assert not [name for name in known if not any(is_in(name, module) for module in below)]


def test_environments_and_policies_know_nothing_of_a_run():
    for room in ("hpamdp.run", "hpamdp.commands", "hpamdp.config", "hpamdp.cli"):
        assert not importers(room, inside="hpamdp.env") | importers(room, inside="hpamdp.policies")


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        ("hpamdp.analysis", "hpamdp.run"),
        ("hpamdp.env", "hpamdp.analysis"),
        ("hpamdp.policies.base", "hpamdp.policies.shared"),
        ("hpamdp.policies.shared", LOW),
        ("hpamdp.policies.shared", HIGH),
    ],
)
def test_no_import_points_upward(lower, upper):
    for module in [module for module in FILES if is_in(module, lower)]:
        assert not [name for name in loaded_with(module) if is_in(name, upper)], module


def test_the_levels_do_not_know_each_other():
    assert not importers(LOW, inside=HIGH)
    assert not importers(HIGH, inside=LOW)


def test_learners_do_not_know_each_other():
    # A learner may be a folder, such as pets, or have files named after the first: only qpamdp knows qpamdp_*. All of
    # them know its settings.
    def is_one_learner(module: str, learner: str) -> bool:
        name = learner.split(".")[3].removesuffix("_options")
        return module.split(".")[3] == name or learner.startswith(f"{module}_") or module.startswith(f"{LOW}.{name}_")

    knowing = [(module, learner) for learner in LEARNERS for module in importers(learner, inside=LOW)]
    assert not [pair for pair in knowing if not is_one_learner(*pair)]


def test_learners_and_selectors_do_not_know_the_agent():
    assert not importers("hpamdp.policies.agent", inside=LOW) | importers("hpamdp.policies.agent", inside=HIGH)


def test_hydra_wandb_and_minari_stay_in_their_rooms():
    allowed = {"hpamdp.cli", "hpamdp.run.sweep"}
    assert {module for module in importers("hydra") if not is_in(module, "hpamdp.config")} <= allowed
    private = re.compile(r"hydra\._internal|\._(get_node|get_root|value|set_parent|set_flag|normalize_file_name)\b")
    for folder in ("hpamdp", "tests", "experiments", "examples", "docs"):
        for file in (ROOT / folder).rglob("*.py"):
            assert file.name == "test_architecture.py" or not private.search(file.read_text()), file
    assert importers("wandb") <= {"hpamdp.run.loggers"}
    assert importers("minari") <= {"hpamdp.data.minari", "hpamdp.data.human.minari"}


def test_the_run_gets_learners_selectors_and_problems_only_through_the_config():
    rooms = {
        ".".join(module.split(".")[:3]) for module in FILES if is_in(module, "hpamdp.env") and module.count(".") == 3
    }
    for concrete in (LOW, HIGH, *rooms):
        assert not importers(concrete, inside="hpamdp.run") | importers(concrete, inside="hpamdp.commands")


# What reads a file by running code in it, unless the named argument has the value that forbids it.
UNSAFE_READERS = {
    **dict.fromkeys(("pickle.load", "pickle.loads", "cloudpickle.load", "cloudpickle.loads", "dill.load"), None),
    **dict.fromkeys(("joblib.load", "shelve.open", "marshal.load", "marshal.loads", "pandas.read_pickle"), None),
    **dict.fromkeys(("yaml.load", "yaml.full_load", "yaml.unsafe_load", "eval", "exec"), None),
    "torch.load": ("weights_only", True),
    "np.load": ("allow_pickle", False),
    "numpy.load": ("allow_pickle", False),
    "TensorDict.load_memmap": ("allow_pickle", False),
}


MAY_READ = re.compile(r"(load|loads|load_memmap|read_pickle|eval|exec|shelve\.open)\(")


def unsafe_reads(source):
    """Return the lines of a program that read a file by running code in it."""
    lines = []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name | ast.Attribute):
            continue
        name = ast.unparse(node.func)
        if name in UNSAFE_READERS:
            given = {word.arg: ast.unparse(word.value) for word in node.keywords}
            safe = UNSAFE_READERS[name]
            if safe is None or given.get(safe[0]) != str(safe[1]):
                lines.append(f"{node.lineno}: {ast.unparse(node)}")
    return lines


def test_nothing_reads_a_file_by_running_code_in_it():
    unsafe = "np.load(f)\ntorch.load(f, weights_only=False)\nyaml.load(f, Loader)\npickle.loads(b)"
    assert len(unsafe_reads(unsafe)) == 4
    for folder in ("hpamdp", "experiments", "examples", "docs"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            source = file.read_text()
            assert not MAY_READ.search(source) or not unsafe_reads(source), file


def names_in(file: Path) -> set[str]:
    """Return what a file defines, assigns or imports outside of functions and classes."""
    names, waiting = set[str](), list[ast.AST](ast.parse(file.read_text()).body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            names.add(node.name)
            continue
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.alias):
            names.add((node.asname or node.name).split(".")[0])
        waiting += ast.iter_child_nodes(node)
    return names


def test_studies_and_examples_import_only_what_is_there():
    for file in [each for folder in ("experiments", "examples") for each in sorted((ROOT / folder).rglob("*.py"))]:
        for node in ast.walk(ast.parse(file.read_text())):
            if not isinstance(node, ast.ImportFrom) or node.module is None:
                continue
            path = node.module.replace(".", "/")
            endings = (".py", "/__init__.pyi", "/__init__.py")
            sources = [ROOT / f"{path}{ending}" for ending in endings] + [ROOT / f"tests/{path}.py"]
            ours = path.startswith(("hpamdp/", "experiments/"))
            assert not ours or (ROOT / path).is_dir() or any(each.is_file() for each in sources), (
                f"{file}: {node.module}"
            )
            for source in [each for each in sources if each.is_file()][:1]:
                missing = {alias.name for alias in node.names} - names_in(source)
                missing -= {each.stem for each in (ROOT / path).glob("*")}
                assert not missing, f"{file}: {node.module} lacks {missing}"
