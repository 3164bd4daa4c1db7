"""Compose configs by Hydra from yaml files and a command line, and check them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, TypeGuard

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hpamdp.complaints import as_json, no_such
from hpamdp.config.command_line import parsed_words
from hpamdp.config.components import CALLBACK, GROUPS, TARGET, file_of
from hpamdp.config.errors import ConfigError, MissingChoiceError
from hpamdp.config.schema import Config, RunConfig, check_run, checked_config
from hpamdp.config.yaml_files import SCHEME
from hpamdp.messages import first_line
from hpamdp.shell import for_hydra

NESTED = "a yaml file names itself among its defaults, or a value nests too deep"
RECIPE = "recipe"
_LONGEST_NAME = 200  # letters of a yaml file's name
_SHOWN = 200  # letters of a command line in an error
_NAMED_BY_YAML = "a yaml file names the class; give the name of the file"
# Entries that the learner of a single option cannot have, and the advice in the error.
_NOT_PER_OPTION = {
    TARGET: _NAMED_BY_YAML,
    "budget": "a run has one budget; set total_frames, num_envs, steps_per_batch or eval.every",
    "checkpoint": "a checkpoint fills all learners; set low.checkpoint",
    "freeze": "all learners are frozen or none; set low.freeze",
    "per_option": "an option has one learner",
}


def conf_dir() -> Path:
    """Return the folder of the yaml files."""
    folder = package_dir("conf")
    if folder is None or not (folder / "config.yaml").is_file():
        package = _package()
        raise ConfigError(f"there is no conf/config.yaml in {package} or beside it; install hpamdp again")
    return folder


def package_dir(name: str) -> Path | None:
    """Return a folder inside the installed package, or beside the package in a clone; None if there is neither."""
    folders = (_package() / name, _package().parent / name)
    return next((folder for folder in folders if folder.is_dir()), None)


def _package() -> Path:
    return Path(__file__).resolve().parent.parent


def read(cfg: DictConfig) -> Config:
    """Check the composed config.

    Args:
        cfg: as Hydra composes conf/config.yaml, with or without its `hydra` part.

    Raises:
        ConfigError: a value is wrong, or nothing is chosen for a group.
    """
    given, names, folders = _as_plain_values(cfg)
    return replace(check(given, names), config_dirs=folders)


def read_run(cfg: DictConfig) -> tuple[RunConfig, tuple[str, ...]]:
    """Check the values of the run alone; return them, and the folders of yaml files besides conf/.

    This is for a config that a saved run completes. The choices of the groups are then those of the saved run, and
    settings that need each other may come from either config.

    Raises:
        ConfigError: a value is wrong, or nothing is chosen for a group.
    """
    given, _, folders = _as_plain_values(cfg, may_lack=True)
    return check_run(given), folders


def _as_plain_values(
    cfg: DictConfig, *, may_lack: bool = False
) -> tuple[dict[str, Any], Mapping[str, str], tuple[str, ...]]:
    """Return the composed config as plain values, the names, and the folders of yaml files.

    `may_lack`: see `plain`.
    """
    names = chosen_names(cfg)
    for group in GROUPS:
        if cfg.get(group) is None or TARGET not in cfg[group]:
            if names.get(group) is not None:
                raise ConfigError(f"{group}={names[group]}: {file_of(group, names[group])} names no class as {TARGET}")
            raise ConfigError(f"{group}: nothing chosen; set {group}=NAME with one of the files in conf/{group}")
    own = OmegaConf.masked_copy(cfg, [str(name) for name in cfg if name != "hydra"])
    folders: tuple[str, ...] = ()
    if "hydra" in cfg or HydraConfig.initialized():
        node = cfg.hydra if "hydra" in cfg else HydraConfig.get()
        _check_found(node, names)
        folders = searched_folders(node)
    return plain(own, may_lack=may_lack), names, folders


def searched_folders(node: Any) -> tuple[str, ...]:
    """Return the folders of yaml files that the command line adds to conf/, as absolute paths.

    Args:
        node: the config's `hydra` part.
    """
    added = [each for each in node.runtime.config_sources if each.provider not in ("hydra", "main", "schema")]
    return tuple(str(Path(each.path).absolute()) for each in added if each.schema in ("file", SCHEME))


def _check_found(node: Any, names: Mapping[str, str]) -> None:
    """Refuse a missing recipe or folder of yaml files, which Hydra leaves out without a message.

    Args:
        node: the config's `hydra` part.
        names: the name that was chosen for each group.
    """
    for path in node.searchpath:
        scheme, _, folder = str(path).rpartition("://")
        if scheme in ("", "file", SCHEME) and not Path(folder).is_dir():
            raise ConfigError(f"hydra.searchpath={folder}: there is no such folder")
    env = names["env"]
    own_recipes = {
        RECIPE: f"{env}_{names['low']}",
        f"{RECIPE}/high": f"{env}_{names['high']}",
        f"{RECIPE}/env": env,
    }
    for group, own_recipe in own_recipes.items():
        recipe = names.get(group)
        is_said = any(word.startswith(f"{group}=") for word in words_in(node.overrides.task))
        if recipe is None or (recipe == own_recipe and not is_said):
            continue
        if recipe not in names_of(group):
            raise ConfigError(f"{group}={recipe}: {no_such(f'file in conf/{group}', recipe, names_of(group))}")


def check(given: Mapping[str, Any], names: Mapping[str, str]) -> Config:
    """Check the config as plain values, without resolving text.

    Args:
        given: the values of the run, and for each group a mapping of `_target_` and the settings.
        names: the name that was chosen for each group.

    Raises:
        ConfigError: a value is wrong.
    """
    run = check_run(given)
    learners = _learners_of_options(run, names["env"])
    return checked_config(run, given, names, learners, listed_callbacks(run.callbacks, run.model_dump()))


def _learners_of_options(run: RunConfig, env: str) -> dict[str, tuple[str, dict[str, Any]]]:
    """Return each learner in `low.per_option`: its name, and its yaml file and recipe with the given settings."""
    choices = {f"low.per_option.{option}": choice for option, choice in (run.low.per_option or {}).items()}
    learners = _with_files(
        choices,
        "low",
        "a learner",
        lambda name: [choosing("env", env), choosing("low", name)],
        run.model_dump(),
        _NOT_PER_OPTION,
    )
    return dict(zip(run.low.per_option or {}, learners, strict=True))


def listed_callbacks(choices: Sequence[Any], run: Mapping[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Return each callback of a list: its name, and its yaml file with the given settings.

    Args:
        choices: the value `callbacks` of the run.
        run: values of the run, to which the yaml files may refer.

    Raises:
        ConfigError: an entry names no yaml file of the searched folders.
    """
    places = {f"callbacks.{i}": choice for i, choice in enumerate(choices)}
    refused = {TARGET: _NAMED_BY_YAML}
    return _with_files(places, CALLBACK, "a callback", lambda name: [f"+{choosing(CALLBACK, name)}"], run, refused)


def _with_files(
    choices: Mapping[str, Any],
    group: str,
    what: str,
    words: Callable[[str], list[str]],
    run: Mapping[str, Any],
    refused: Mapping[str, str],
) -> list[tuple[str, dict[str, Any]]]:
    """Return the name of each entry of a list or mapping, and its yaml file with the given settings.

    Args:
        choices: the entries by their places, such as `callbacks.0`.
        group: the group of the yaml files.
        what: what an entry must name.
        words: returns the words that choose a yaml file.
        run: values of the run, to which the yaml files may refer.
        refused: settings that an entry may not have, with the advice for the error.

    Raises:
        ConfigError: an entry names no yaml file, or has a refused setting.
    """

    @cache  # somebody else's file may name a class as often as it likes
    def written(name: str) -> dict[str, Any]:
        cfg = compose(words(name))
        return plain_groups(cfg, run, [group])[group] if cfg.get(group) else {}

    found = []
    for where, choice in choices.items():
        given = dict(choice) if isinstance(choice, Mapping) else {"name": choice}
        name = given.pop("name", None)
        if not is_name(name):
            raise ConfigError(f"{where}={as_json(choice)}: must be the name of {what}, or its name and settings")
        for setting, instead in refused.items():
            if setting in given:
                raise ConfigError(f"{where}.{setting}: {instead}")
        try:
            own = written(name)
        except MissingChoiceError as error:
            raise ConfigError(f"{where}={name}: {no_such(f'file in conf/{group}', name, error.known)}") from error
        if TARGET not in own:
            raise ConfigError(f"{where}={name}: {file_of(group, name)} names no class as {TARGET}")
        found.append((name, {**own, **given}))
    return found


def compose(overrides: list[str]) -> DictConfig:
    """Return the config of these words, from the folders that the running job searches for yaml files.

    Raises:
        MissingChoiceError: no folder has the yaml file that a word chooses.
    """
    if HydraConfig.initialized():
        given = words_in(HydraConfig.get().overrides.hydra)
        overrides = [*(word for word in given if word.startswith("hydra.searchpath=")), *overrides]
    try:
        if GlobalHydra.instance().is_initialized():
            return hydra.compose("config", overrides)
        with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
            return hydra.compose("config", overrides)
    except hydra.errors.MissingConfigException as error:
        raise MissingChoiceError(str(error.missing_cfg_file), error.options or ()) from error


def beginning_of(words: Sequence[str]) -> str:
    """Return the words of a command line for an error, cut short if they are long."""
    return f"{' '.join(words)[:_SHOWN]}: "


def chosen_names(cfg: DictConfig) -> Mapping[str, str]:
    """Return the name that was chosen for each group, from the config's `hydra` part or from the running job."""
    node = cfg.hydra if "hydra" in cfg else HydraConfig.get()
    return node.runtime.choices


def job_overrides() -> list[str]:
    """Return the words of the running job's command line, as the user wrote them."""
    return words_in(HydraConfig.get().overrides.task)


def words_in(node: Any) -> list[str]:
    """Return the words that a part of Hydra's config lists, without resolving `${` in them."""
    words: Any = OmegaConf.to_container(node, resolve=False)
    return [str(word) for word in words]


def names_of(group: str) -> tuple[str, ...]:
    """Return the names of a group's yaml files in all searched folders."""
    try:
        compose([f"+{group}@__none__=__none__"])  # added to the group's own choice, which may be optional
    except MissingChoiceError as error:  # Hydra lists the names only here.
        return error.known
    return ()


def plain_groups(
    cfg: DictConfig, run: Mapping[str, Any], groups: Iterable[str], *, may_lack: bool = False
) -> dict[str, dict[str, Any]]:
    """Return these groups of a composed config as plain values.

    Settings that refer to a number of the run, such as `${total_frames}`, take it from `run`, but never text.
    `may_lack`: see `plain`.
    """
    cfg = cfg.copy()
    for name in RunConfig.model_fields:
        if name in cfg and isinstance(run.get(name), int | float):
            cfg[name] = run[name]
    return {group: plain(cfg[group], group, may_lack=may_lack) for group in groups}


def plain(node: Any, where: str = "the config", *, may_lack: bool = False) -> dict[str, Any]:
    """Resolve a part of the config into plain Python values.

    Args:
        node: the part.
        where: its name in errors.
        may_lack: whether a value may be missing, since a saved run has it. Then it is `???`.

    Raises:
        ConfigError: the part is no mapping, a value is missing, or a value cannot be resolved.
    """
    if not isinstance(node, Mapping | DictConfig):
        raise ConfigError(f"{where}={as_json(node)}: must be a mapping")
    if not isinstance(node, DictConfig):
        return dict(node)
    try:
        container = OmegaConf.to_container(node, resolve=True, throw_on_missing=not may_lack)
    except OmegaConfBaseException as error:
        raise ConfigError(f"{error.full_key or where}: {first_line(error)}") from error
    except RecursionError as error:
        raise ConfigError(f"{where}: a value refers to itself, or nests too deep") from error
    assert isinstance(container, dict)
    return {str(name): value for name, value in container.items()}


def is_name(name: object) -> TypeGuard[str]:
    """Return whether a value can name a group's yaml file: words and slashes, but no way out of the folder."""
    if not isinstance(name, str) or len(name) > _LONGEST_NAME:
        return False
    return re.fullmatch(r"\w[\w.+-]*(/\w[\w.+-]*)*", name) is not None


def setting_of(word: str) -> str:
    """Return the name of the setting, or the group, that a word of a command line gives, adds or deletes."""
    return word.partition("=")[0].lstrip("+~")


def settings_in(word: str) -> list[str]:
    """Return the names of all settings that a word gives: `eval={every:5}` gives `eval` and `eval.every`."""
    try:
        (override,) = parsed_words([word])
    except (RecursionError, ValueError):  # reported when the config is composed
        return [setting_of(word)]
    return _names_in(setting_of(word), None if override.is_sweep_override() else override.value())


def _names_in(name: str, value: Any) -> list[str]:
    entries = value.items() if isinstance(value, Mapping) else ()
    return [name, *(each for key, entry in entries for each in _names_in(f"{name}.{key}", entry))]


def choosing(group: str, name: str) -> str:
    """Return the word that chooses a yaml file for a group. The quotes make names of `null` and `3`."""
    return f"{group}={for_hydra(name)}"
