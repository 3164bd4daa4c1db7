"""What the tests share."""

import csv
import gc
import itertools
import math
import multiprocessing
import os
import pickle
import random
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import synthetic_human
import torch
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hpamdp.cli import main
from hpamdp.config import outside_jobs
from hpamdp.config.command_line import parsed_words, search_word
from hpamdp.config.components import GROUPS
from hpamdp.config.compose import read
from hpamdp.config.schema import Config, RunConfig
from hpamdp.config.yaml_files import CompletedFiles
from hpamdp.data.human import released_file
from hpamdp.data.human.released_file import HumanData
from hpamdp.env.boatdock import harbour, planner
from hpamdp.run import assemble
from hpamdp.run.assemble import choose_selector
from hpamdp.run.recorder import Recorder
from hpamdp.run.state_file import StateFile

# Tests that are started in the background or under nohup inherit ignored signals, and so would what they start.
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGXCPU):
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)

# Two processes on two cores fight over threads otherwise.
torch.set_num_threads(1)

# With Python's own thresholds, full collections take a twentieth of the time of the tests, and find little.
gc.set_threshold(700, 10, 200)

CONF = Path(__file__).resolve().parent.parent / "conf"
CROSSING = Path(__file__).resolve().parent.parent / "examples" / "crossing"
sys.path.insert(0, str(CROSSING))
# The folders of the tests' own yaml files and of that of the example, and the word that adds them.
OWN_FOLDERS = (Path(__file__).resolve().parent / "conf", CROSSING / "conf")
OWN = search_word([*map(str, OWN_FOLDERS)])


def assert_same(one: object, other: object, where: str = "") -> None:
    """Compare nested values of the same types to the last bit."""
    assert type(one) is type(other), where
    if isinstance(one, dict):
        assert one.keys() == other.keys(), where
        for key, value in one.items():
            assert_same(value, other[key], f"{where}/{key}")
    elif isinstance(one, list | tuple):
        assert len(one) == len(other), where
        for index, (mine, theirs) in enumerate(zip(one, other, strict=True)):
            assert_same(mine, theirs, f"{where}/{index}")
    elif torch.is_tensor(one):
        assert one.dtype == other.dtype and one.shape == other.shape, where
        assert bytes_of(one) == bytes_of(other), where
    else:
        assert repr(one) == repr(other), where  # NaN, too


def bytes_of(tensor: torch.Tensor) -> bytes:
    return tensor.contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()


def rows_of(folder: Path) -> list[dict[str, str]]:
    """Return the rows of a run's metrics."""
    with (folder / "metrics.csv").open() as file:
        return list(csv.DictReader(file))


def signal_after(number: int, sent: int = signal.SIGINT) -> AbstractContextManager[object]:
    """Send this process a signal once this many batches have been learned from."""
    take, batches = Recorder.take, itertools.count(1)

    def watched(self, batch, scalars):
        take(self, batch, scalars)
        if next(batches) == number:
            os.kill(os.getpid(), sent)

    return mock.patch.object(Recorder, "take", watched)


def parts_of(file: Path) -> dict[str, Any]:
    """Return the parts of a saved agent."""
    opened = StateFile(file)
    return {name: opened.read(name) for name in opened.names}


@pytest.fixture(scope="module", autouse=True)
def old_objects_not_collected() -> None:
    """Exempt what earlier tests have left, above all imported modules, from garbage collections.

    They took a tenth of the time: a collection looks at a million objects of torch and of the tests themselves.
    """
    gc.collect()
    gc.freeze()


def compose_config(overrides: Sequence[str]) -> DictConfig:
    """Compose conf/config.yaml as the command line does; yaml files in tests/conf are found, too.

    Runs are not filmed unless a test asks for it, which saves it half a second.
    """
    overrides = [*([] if any(word.startswith("film=") for word in overrides) else ["film=false"]), *overrides]
    if any(word.startswith("hydra.searchpath=") for word in overrides):
        return pickle.loads(_composed(*overrides))
    return with_values([OWN, *overrides], lambda words: pickle.loads(_composed(*words)))


@cache
def _composed(*overrides: str) -> bytes:
    """Compose the words of each test once."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return pickle.dumps(compose("config", [*overrides], return_hydra_config=True))


def with_values(words: Sequence[str], composed: Callable[[Sequence[str]], DictConfig]) -> DictConfig:
    """Compose the choices of yaml files among words, and then set the other words as Hydra sets them.

    Few tests have choices of their own, and composing takes fifty times as long as setting values. Where a value cannot
    be set, all words are composed, which says why.
    """
    try:
        overrides = [_parsed(word) for word in words]
        cfg = composed([word for word, each in zip(words, overrides, strict=True) if not _is_value(each)])
        for each in filter(_is_value, overrides):
            OmegaConf.update(cfg, each.key_or_group, each.value(), merge=True)
    except (HydraException, OmegaConfBaseException):
        return composed(words)
    cfg.hydra.overrides.task = [word for word in words if not word.startswith("hydra.")]
    return cfg


@cache
def _parsed(word: str) -> Override:
    return parsed_words([word])[0]


def _is_value(override: Override) -> bool:
    """Return whether a word sets a value that chooses no yaml file and refers to no other value."""
    name = override.key_or_group
    is_setting = "." in name or (name in RunConfig.model_fields and name not in (*GROUPS, "callbacks"))
    is_plain = override.type == OverrideType.CHANGE and not override.is_sweep_override() and override.package is None
    return is_setting and is_plain and not name.startswith("hydra.") and "${" not in override.input_line


def make_config(overrides: Sequence[str]) -> Config:
    """Return the checked config of a command line."""
    return choose_selector(read(compose_config(overrides)))


def choices(group: str) -> list[str]:
    """Return the names in a group of conf/."""
    return sorted(file.stem for file in (CONF / group).glob("*.yaml"))


# The simulators of problems that need an extra that `dev` lacks.
SIMULATORS = {"traffic": "libsumo", "primitives": "metaworld", "rddl": "pyRDDLGym"}


def buildable(problems: Iterable[str]) -> list:
    """Return problems as parameters of a test that builds them. Those whose simulator is not installed skip."""
    missing = {name for name, module in SIMULATORS.items() if find_spec(module) is None}
    skip = pytest.mark.skipif(True, reason="needs the extra of its name")
    return [pytest.param(name, marks=skip if name in missing else ()) for name in problems]


# The learners that learn from presses of their own; the others learn from data sets alone.
TRAINED = sorted({*choices("low")} - {"bc"})
# One of each kind: on-policy, with a replay, with a model, of episodes. Tests of all learners are quick with these.
OF_EACH_KIND = ("hppo", "hyar", "pets", "qpamdp")


@contextmanager
def global_generators_unmoved() -> Iterator[None]:
    """Assert that what happens inside moves none of the global random generators."""

    def states() -> tuple:
        return torch.get_rng_state().tolist(), str(np.random.get_state()), random.getstate()

    before = states()
    yield
    assert states() == before


# The number of updates from which a run compiles them by default.
UPDATES_THAT_PAY = assemble._UPDATES_THAT_PAY


@pytest.fixture(autouse=True)
def nothing_compiled_by_default(request) -> Iterator[None]:
    """Have quick tests compile updates only if they say so.

    Some tests make a few updates of a run with its usual length, for which compilation would pay.
    """
    with pytest.MonkeyPatch.context() as patch:
        if request.node.get_closest_marker("slow") is None:
            patch.setattr(assemble, "_UPDATES_THAT_PAY", math.inf)
        yield


@pytest.fixture(scope="session", autouse=True)
def draw_all() -> Iterator[Callable[..., object]]:
    """Have runs draw no figures, which takes longer than the runs of most tests."""
    from hpamdp.analysis import figures  # matplotlib takes long to import

    with pytest.MonkeyPatch.context() as patch:
        drawing = figures.draw_all
        patch.setattr(figures, "draw_all", lambda *_: [])
        yield drawing


@pytest.fixture(scope="session", autouse=True)
def disk_not_waited_for() -> Iterator[None]:
    """Have files written without waiting for the disk, which takes a third of a short run; no test cuts the power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def best_scores_planned_once() -> Iterator[None]:
    """Have boats plan the best scores of the same layouts once; nearly all evaluations of the tests have the same."""
    plan, planned = planner.best_scores, {}

    def plan_once(rules, layout, keymap):
        places = [column.numpy(force=True).tobytes() for column in (*layout, keymap)]
        given = repr(rules), torch.get_default_dtype(), *places
        if given not in planned:
            planned[given] = plan(rules, layout, keymap)
        return planned[given].to(keymap.device, copy=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner, "best_scores", plan_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def words_composed_once() -> Iterator[None]:
    """Have Python code compose the same choices once, which takes a third of a short run.

    Words that choose a class or add a folder are composed each time.
    """
    compose_words, composed = outside_jobs._compose, {}

    def is_of_the_package(word: str, conf: Path) -> bool:
        name, _, value = word.partition("=")
        file = conf / name / (value.strip('"') + ".yaml")
        return file.is_file() if file.parent.is_dir() else not name.startswith("hydra.")

    def compose_once(words: Sequence[str], conf: Path) -> DictConfig:
        if conf != CONF or not all(is_of_the_package(word, conf) for word in words):
            return compose_words(words, conf)

        def once(words: Sequence[str]) -> DictConfig:
            if tuple(words) not in composed:
                composed[tuple(words)] = pickle.dumps(compose_words(words, conf))
            return pickle.loads(composed[tuple(words)])

        return with_values(words, once)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(outside_jobs, "_compose", compose_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def yaml_files_read_once() -> Iterator[None]:
    """Have Hydra read each yaml file of conf/ and of the tests once, which takes a third of a composition."""
    read_file, read_before = CompletedFiles.load_config, {}

    def read_once(self, config_path: str) -> ConfigResult:
        if Path(self.path) not in (CONF, *OWN_FOLDERS):
            return read_file(self, config_path)
        file = self.provider, self.path, config_path
        if file not in read_before:
            read_before[file] = pickle.dumps(read_file(self, config_path))
        return pickle.loads(read_before[file])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CompletedFiles, "load_config", read_once)
        yield


@pytest.fixture
def with_figures(draw_all, monkeypatch) -> None:
    """Have runs draw their figures."""
    monkeypatch.setattr("hpamdp.analysis.figures.draw_all", draw_all)


@pytest.fixture(scope="session")
def people() -> HumanData:
    """The released recording, which takes seconds to read."""
    if not os.environ.get(released_file.PATH_VARIABLE):
        pytest.skip(f"{released_file.PATH_VARIABLE} is not set")
    return released_file.read()


@pytest.fixture(scope="session")
def people_file(tmp_path_factory) -> Path:
    """A file of the released form with a few made-up people."""
    return synthetic_human.write(tmp_path_factory.mktemp("human") / "people.mat")


@pytest.fixture(scope="session")
def people_in_one_frame(people) -> HumanData:
    """The same with `one_frame=True`."""
    episodes, presses = (table.clone() for table in people)
    shift = torch.tensor(harbour.CENTRE) - episodes["centre"]
    for name in ("start", "goal", "centre"):
        episodes[name] += shift
    for name in ("position", "next_position"):
        presses[name] += shift[presses["episode"]]
    return HumanData(episodes, presses)


def forked(function: Callable[..., object], *arguments: object) -> int | None:
    """Call a function in a process forked from this one, which has its imports done; return the exit code."""
    child = multiprocessing.get_context("fork").Process(target=function, args=arguments)
    child.start()
    child.join()
    return child.exitcode


# Imported before workers are forked: what a run with workers needs, with Numba, which problems import.
WORKER_MODULES = ("hpamdp.run.collection.multi", "hpamdp.env.kernels", "hpamdp.env.gymnasium.environment")


@contextmanager
def forked_workers() -> Iterator[None]:
    """Start worker processes as forks of one process that has imported what they need.

    By default each of them spends seconds on its imports. Arguments of the processes are pickled either way.
    """
    from hpamdp.env.gymnasium import processes

    before = multiprocessing.get_start_method()
    multiprocessing.set_forkserver_preload([*WORKER_MODULES])
    multiprocessing.set_start_method("forkserver", force=True)
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(processes, "START_METHOD", "forkserver")
            yield
    finally:
        multiprocessing.set_start_method(before, force=True)


@pytest.fixture
def quick_workers() -> Iterator[None]:
    """Have a test start its workers as `forked_workers`."""
    with forked_workers():
        yield


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """Run the command line in an empty folder and return its exit code, its stdout and its stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # so that what `main` sets is undone
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)  # and what Hydra does

    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["run.py", *words])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code
        out, err = capsys.readouterr()
        return code, out, err

    return run
