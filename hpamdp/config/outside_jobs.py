"""Compose configs outside of Hydra's jobs: for Python code, and for commands such as `hpamdp watch`."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hpamdp.complaints import as_json
from hpamdp.config.command_line import folder_path, parse, search_word
from hpamdp.config.components import (
    SUPPLIED_ARGUMENTS,
    TARGET,
    USUAL_LEARNER,
    check_base_class,
    defaults_of,
    file_of,
    name_of_passed,
    settings_model,
)
from hpamdp.config.compose import conf_dir, is_name, setting_of
from hpamdp.config.errors import ConfigError
from hpamdp.config.hydra_errors import BEFORE_A_JOB, explained, missing_setting
from hpamdp.messages import as_code, first_line
from hpamdp.shell import escaped

# Hydra keeps one state for the whole process.
_HYDRA = threading.RLock()
# Arguments of an environment of the user's own, which may need an array rather than a list.
_OF_CONSTRUCTOR = "env.kwargs"
# Recommended budget of a learner's class that has no yaml file.
_BUDGET = {"num_envs": 16, "steps_per_batch": 128, "total_frames": 200_000, "eval_every": 10_000}


@contextmanager
def composed(words: Sequence[str], settings: Iterable[tuple[str, Any]] = ()) -> Iterator[DictConfig]:
    """Compose the words of a command line, and change the result by settings from Python code.

    Inside the block, the folders that the words add are searched, and `job_overrides` returns what was given. Other
    threads wait until the block ends. Then Hydra's earlier state comes back.

    Args:
        words: choices of yaml files, and settings in Hydra's grammar.
        settings: names as on the command line, without `env.` for settings of the problem if nothing else has the
            name, and their values.

    Yields:
        The config with its `hydra` part.

    Raises:
        ConfigError: the words cannot be composed, or a setting does not exist, has no value that a yaml file can hold,
            or is given twice.
    """
    with own_hydra():
        cfg = _compose(words, conf_dir())
        _change(cfg, settings, conf_dir())
        HydraConfig.instance().set_config(cfg)  # `compose` takes the searched folders from it
        yield cfg


@contextmanager
def searched(words: Sequence[str]) -> Iterator[None]:
    """Inside the block, search the folders of `hydra.searchpath`, if it is among these words.

    This takes no time, because nothing is composed. Other threads wait until the block ends.
    """
    with own_hydra():
        own = [each for each in words if each.startswith("hydra.searchpath=")]
        node: Any = OmegaConf.create({"hydra": {"overrides": {"hydra": own}}})  # what `compose` reads
        HydraConfig.instance().cfg = node
        yield


@contextmanager
def own_hydra() -> Iterator[None]:
    """Let the block change Hydra's state. Afterwards the state from before comes back."""
    with _HYDRA:
        outer, outer_config = GlobalHydra.instance().hydra, HydraConfig.instance().cfg  # of a program that uses Hydra
        GlobalHydra.instance().clear()
        try:
            yield
        finally:
            GlobalHydra.instance().hydra, HydraConfig.instance().cfg = outer, outer_config


def _compose(words: Sequence[str], conf: Path) -> DictConfig:
    line = parse(words, conf)
    try:
        with hydra.initialize_config_dir(str(conf), version_base="1.3"):
            return hydra.compose("config", line.words, return_hydra_config=True)
    except ConfigError:
        raise
    except BEFORE_A_JOB as error:
        raise ConfigError(explained(error, line, conf)) from error


def _change(cfg: DictConfig, settings: Iterable[tuple[str, Any]], conf: Path) -> None:
    """Change a composed config by settings from Python code, as Hydra changes it by the words of a command line.

    Raises:
        ConfigError: a setting does not exist, has no value that a yaml file can hold, or is given twice.
    """
    given: dict[str, Any] = {}
    words = []
    for written, value in settings:
        name, is_new = written.lstrip("+"), written.startswith("+")
        if "." not in name and name not in cfg and name in cfg.env:
            name = f"env.{name}"
        plain = plain_value(name, value)
        singles = dict(_single_values(name, plain))
        for single in singles or [name]:
            wrong = None if is_new else missing_setting(cfg, single, conf)
            if wrong is not None:
                raise ConfigError(wrong)
        for single, each in singles.items():
            _check_once(single, each, given)
        given |= singles
        before = OmegaConf.select(cfg, name, throw_on_resolution_failure=False)
        has_entries = isinstance(before, DictConfig)  # of which a mapping changes some
        words += [f"{one}={as_json(each)}" for one, each in (singles if has_entries else {name: plain}).items()]
        try:
            OmegaConf.update(cfg, name, plain, merge=True, force_add=is_new)
        except OmegaConfBaseException as error:
            raise ConfigError(f"{name}={as_code(value)}: {first_line(error)}") from error
    cfg.hydra.overrides.task.extend(words)


def _check_once(name: str, value: Any, given: Mapping[str, Any]) -> None:
    """Refuse a setting that was given before, also one inside a mapping, such as `eval={"seed": 7}` and `eval.seed`.

    On a command line the last word counts.
    """
    for earlier, first in given.items():
        if f"{name}.".startswith(f"{earlier}.") or earlier.startswith(f"{name}."):
            raise ConfigError(given_twice(min(name, earlier, key=len), first, value))


def _single_values(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the entries of a mapping, of the mappings in it and so on, or else the value itself; nothing if empty."""
    if not isinstance(value, Mapping):
        yield name, value
        return
    for entry, each in value.items():
        yield from _single_values(f"{name}.{entry}", each)


def plain_value(name: str, value: Any) -> Any:
    """Return the value of a setting from Python code as a yaml file could hold it. A `${` in it stays text.

    Raises:
        ConfigError: the value is no number, text, list or mapping of these.
    """
    if hasattr(value, "item") and getattr(value, "ndim", None) == 0:  # a number of NumPy or torch
        value = value.item()
    elif hasattr(value, "tolist") and getattr(value, "ndim", None) == 1 and not name.startswith(_OF_CONSTRUCTOR):
        value = value.tolist()
    if isinstance(value, str | Path):
        return escaped(str(value))
    if value is None or isinstance(value, bool | int | float):
        return value
    if isinstance(value, list | tuple | range):
        return [plain_value(name, item) for item in value]
    if isinstance(value, Mapping):
        for entry in value:
            if not is_name(entry):
                raise ConfigError(
                    f"{name}: the name {as_code(entry)} of an entry must be a text of letters, digits, _, . and -"
                )
        return {entry: plain_value(name, item) for entry, item in value.items()}
    raise ConfigError(f"{name}={as_code(value)}: must be a number, a text, or a list or mapping of these")


def check_no_sweep(cfg: DictConfig, words: Sequence[str]) -> None:
    """Refuse an experiment that is a sweep, unless words give every swept setting a value.

    Raises:
        ConfigError: the message names the swept settings.
    """
    given = {setting_of(each) for each in words}
    swept = [name for name in cfg.hydra.sweeper.get("params") or {} if name not in given]
    if cfg.hydra.mode == RunMode.MULTIRUN and swept:
        chosen = cfg.hydra.runtime.choices
        raise ConfigError(
            f"experiment={chosen['experiment']}: a sweep over {', '.join(swept)}, for the command line; to train one "
            f"agent, give {'it a value' if len(swept) == 1 else 'each of them a value'}"
        )


def given_twice(name: str, first: Any, second: Any) -> str:
    """Return the error for a setting that arguments give twice."""
    return f"{name}: given twice, as {as_code(first)} and as {as_code(second)}; leave one out"


def searching(folders: Sequence[str | Path], where: str = "config_dirs") -> list[str]:
    """Return the word that adds folders of yaml files, if there are any.

    Args:
        folders: the folders.
        where: the argument or flag that names them, for the error.

    Raises:
        ConfigError: a folder does not exist.
    """
    if isinstance(folders, str | Path):
        folders = [folders]
    if not isinstance(folders, list | tuple) or not all(isinstance(each, str | Path) and str(each) for each in folders):
        raise ConfigError(f"{where}={as_code(folders)}: must be a list of folders")
    return [search_word([folder_path(folder, where) for folder in folders])] if folders else []


# Groups and names of passed classes that several modules have.
_shared_names: set[tuple[str, str]] = set()


def check_is_single(group: str, name: str) -> None:
    """Refuse the name that a saved run gives for a class, if classes of several modules had it in this process.

    Raises:
        ConfigError: there are several.
    """
    if (group, name) in _shared_names:
        raise ConfigError(f"{group}={name}: several classes have this name; pass that of the saved run as {group}")


def choosing_class(group: str, cls: type) -> str:
    """Return the name of a class in a group: that of its yaml file, or a choice of its own, which Hydra then knows.

    Until `composed` ends, no other thread may choose a class of the same name, so call it within `own_hydra`.

    Raises:
        ConfigError: the class does not fit the group, or has the name of a yaml file.
    """
    dotted = name_of_passed(cls)
    files = {file.stem: yaml.safe_load(file.read_text()) for file in sorted((conf_dir() / group).glob("*.yaml"))}
    own = [name for name, values in files.items() if values.get(TARGET) == dotted]
    if own:  # the file with the fewest differences from the class's defaults
        return min(own, key=lambda name: len(files[name]))
    name = cls.__name__
    if name in files:
        raise ConfigError(f"{group}: {dotted} has the name of {file_of(group, name)}; rename the class")
    stored = ConfigStore.instance().repo.get(group, {}).get(f"{name}.yaml")
    if stored is not None and stored.node.get(TARGET) != dotted:
        _shared_names.add((group, name))
    check_base_class(group, name, dotted)
    more = {"low": {"budget": _BUDGET}, "env": USUAL_LEARNER}.get(group, {})
    settings = defaults_of(settings_model(cls, SUPPLIED_ARGUMENTS[group]))
    ConfigStore.instance().store(name=name, group=group, node={TARGET: dotted, **settings, **more})
    return name
