"""Parse, check and complete the words of a command line."""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hpamdp import __version__
from hpamdp.complaints import no_such
from hpamdp.config.components import CALLBACK
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import RESUME_AUTO
from hpamdp.config.yaml_files import SCHEME, completed_path
from hpamdp.shell import for_hydra, setting

GRAMMAR = "not understood; write GROUP=CHOICE or SETTING=VALUE"
# The setting that adds folders of yaml files.
SEARCH_PATH = "hydra.searchpath"
# The folder of conf/ with what `hpamdp tune` searches for each learner.
SEARCH = "search"
# Flags of Hydra, with their short forms and their arguments for argparse.
_SWITCH: dict[str, Any] = {"action": "store_true"}
_INFO = ("all", "config", "defaults", "defaults-tree", "plugins", "searchpath")
_FLAGS: dict[str, tuple[str, dict[str, Any]]] = {
    "help": ("-h", _SWITCH),
    "hydra-help": ("", _SWITCH),
    "cfg": ("-c", {"choices": ("job", "hydra", "all")}),
    "resolve": ("", _SWITCH),
    "package": ("-p", {}),
    "run": ("-r", _SWITCH),
    "multirun": ("-m", _SWITCH),
    "shell-completion": ("-sc", _SWITCH),
    "config-path": ("-cp", {}),
    "config-name": ("-cn", {}),
    "config-dir": ("-cd", {}),
    "info": ("-i", {"nargs": "?", "const": "all", "choices": _INFO}),
}


@dataclass(frozen=True)
class CommandLine:
    """A command line in Hydra's grammar.

    Attributes:
        flags: the values of flags such as `--multirun` and `--config-dir`, by their names.
        overrides: the settings.
    """

    flags: dict[str, Any]
    overrides: tuple[Override, ...]

    @property
    def words(self) -> list[str]:
        """The settings as they were written."""
        return [override.input_line or "" for override in self.overrides]

    @property
    def is_multirun(self) -> bool:
        """Whether several jobs are to run."""
        return bool(self.flags["multirun"])

    @property
    def only_shows(self) -> bool:
        """Whether the command shows something instead of running a job."""
        return any(self.flags[name] for name in ("cfg", "info", "hydra-help", "shell-completion"))

    def argv(self) -> list[str]:
        """Return the words of the whole command line."""
        flags = []
        for name, value in self.flags.items():
            if value:
                flags += [f"--{name}"] if value is True else [f"--{name}", value]
        return [*flags, *self.words]

    def given(self) -> dict[str, Override]:
        """Return the settings by their names."""
        return {override.key_or_group: override for override in self.overrides}

    @property
    def search_path(self) -> list[str]:
        """The word that adds the command line's own folders of yaml files, if it has any."""
        return [word for word in self.words if word.startswith(f"{SEARCH_PATH}=")]

    @property
    def folders(self) -> list[Path]:
        """The command line's own folders of yaml files."""
        given = self.given().get(SEARCH_PATH)
        paths = [] if given is None else given.value()
        ours = [str(path).partition(f"{SCHEME}://")[2] for path in paths] if isinstance(paths, list) else []
        return [Path(path) for path in ours if path]

    def with_replaced(self, words: Mapping[str, str]) -> CommandLine:
        """Return the command line with other words for the settings of these names."""
        overrides = {each.key_or_group: each for each in parsed_words([*words.values()])}
        return replace(self, overrides=tuple(overrides.get(each.key_or_group, each) for each in self.overrides))

    def with_words(self, words: Sequence[str]) -> CommandLine:
        """Return the command line with more words in front of its settings."""
        return replace(self, overrides=(*parsed_words(words), *self.overrides))


def parse(argv: Sequence[str], conf: Path) -> CommandLine:
    """Parse the words of a command line, and refuse mistakes that Hydra would not report in one line.

    Args:
        argv: the words after the program's name.
        conf: the folder of the yaml files.

    Raises:
        ConfigError: a flag or a setting does not exist, or a word is not in Hydra's grammar.
    """
    arguments = vars(_parser(argv).parse_args(argv))
    words = arguments.pop("overrides")
    flags = {name: arguments[name.replace("-", "_")] for name in _FLAGS}
    line = CommandLine(flags, parsed_words(words))
    _check_groups(line, conf)
    return _with_completed_folders(line)


def _with_completed_folders(line: CommandLine) -> CommandLine:
    """Have Hydra add the default settings of classes to the yaml files of the command line's own folders.

    Raises:
        ConfigError: the folder of `--config-dir` does not exist.
    """
    folder, given = line.flags["config-dir"], line.given().get(SEARCH_PATH)
    paths = [] if given is None else given.value()
    if (folder is None and given is None) or not isinstance(paths, list) or not all(isinstance(p, str) for p in paths):
        return line  # Hydra reports a wrong value
    if folder is not None:
        paths = [folder_path(folder, "--config-dir"), *paths]
    others = [override for override in line.overrides if override is not given]
    return CommandLine({**line.flags, "config-dir": None}, (*parsed_words([search_word(paths)]), *others))


def folder_path(folder: str | Path, where: str) -> str:
    """Return the path of a folder of yaml files for Hydra.

    Args:
        folder: the folder.
        where: the argument or flag that names it, for the error.

    Raises:
        ConfigError: the folder does not exist.
    """
    if not os.path.isdir(folder):
        raise ConfigError(f"{where}: there is no folder {folder}")
    return completed_path(str(Path(folder).resolve()))


def search_word(paths: Sequence[str]) -> str:
    """Return the word that adds folders of yaml files."""
    return f"{SEARCH_PATH}=[{','.join(for_hydra(completed_path(path)) for path in paths)}]"


def _parser(argv: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(add_help=False)
    parser.error = partial(_refuse, argv)  # type: ignore[method-assign]  # the parser's own prints two lines
    parser.add_argument("--version", action="version", version=f"hpamdp {__version__}, Hydra {hydra.__version__}")
    parser.add_argument("overrides", nargs="*")
    for name, (short, arguments) in _FLAGS.items():
        parser.add_argument(*filter(None, (f"--{name}", short)), **arguments)
    return parser


def _refuse(argv: Sequence[str], message: str) -> NoReturn:
    # argparse finds settings on one side of a flag only.
    split = re.fullmatch(r"unrecognized arguments: ([^-].*=.*)", message)
    if split:
        raise ConfigError(f"{split.group(1)}: settings on both sides of a flag; write all of them after the flags")
    dashed = re.fullmatch(r"unrecognized arguments: --([^ =-][^ =]*=[^ ]*)( .*)?", message)
    if dashed:
        word = dashed.group(1)
        raise ConfigError(f"--{word}: settings have no dashes, write {word}; a wandb sweep ${{args_no_hyphens}}")
    spaced = [
        f"{flag[2:].replace('-', '_')}={value}"
        for flag, value in pairwise(argv)
        if flag in message.split() and flag.startswith("--") and value[:1] != "-" and "=" not in flag + value
    ]
    hint = f"; settings have no dashes, write {' '.join(spaced)}" if spaced else ""
    raise ConfigError(f"{message}; see --help{hint}")


def parsed_words(words: Sequence[str]) -> tuple[Override, ...]:
    """Return words as Hydra's grammar reads them.

    Raises:
        ConfigError: a word is not in the grammar. If its value is a text, the message gives the right form.
    """
    try:
        return tuple(OverridesParser.create().parse_overrides(list(words)))
    except OverrideParseException as error:
        word = error.override
        is_text = re.match(r"[+~]*[A-Za-z_@][\w.@/]*=.", word)
        form = f", and a text with special characters as {as_text(word)}" if is_text else ""
        raise ConfigError(f"{word}: {GRAMMAR}{form}") from error


def _check_groups(line: CommandLine, conf: Path) -> None:
    """Refuse words that Hydra would take, or answer without the choices that there are."""
    for override in line.overrides:
        name = override.key_or_group
        if not name or name == "hydra":
            raise ConfigError(f"{override.input_line}: {GRAMMAR}")
        if name == SEARCH:
            raise ConfigError(f"{override.input_line}: a search is a command; write hpamdp tune low=LEARNER")
        if name == CALLBACK:
            raise ConfigError(f"{override.input_line}: a run has a list of callbacks; write callbacks=[NAME, ...]")
        if not override.is_delete() and override.value() is None and os.path.isdir(conf / name):
            wrong = no_such("choice", "null", choices_in(conf / name), where=f"conf/{name}")
            raise ConfigError(f"{override.input_line}: {wrong}")


def as_text(word: str) -> str:
    """Return `SETTING=VALUE` quoted for the shell and Hydra, so that the value is a text."""
    name, _, value = word.partition("=")
    return setting(name, value)


def choices_in(folder: Path) -> list[str]:
    """Return the choices in a group's folder. A folder of experiments stands for all experiments in it."""
    files = folder.rglob("*.yaml") if folder.name == "experiment" else folder.glob("*.yaml")
    names = [file.relative_to(folder).with_suffix("") for file in files]
    return sorted({str(choice) for name in names for choice in (name, *name.parents[:-1])})


def saved_run(line: CommandLine) -> tuple[str, str] | None:
    """Return the saved run whose choices complete the command line, and the setting that names it, if there is one."""
    values = {o.key_or_group: o.value() for o in line.overrides if not o.is_sweep_override() and not o.is_delete()}
    where = "resume" if values.get("resume") else "checkpoint"
    source = values.get(where)
    if line.is_multirun or not isinstance(source, str) or not source or "${" in source:
        return None
    if where == "resume" and source == RESUME_AUTO:
        return None  # the command line alone describes the run
    is_refused = where == "checkpoint" and values.get("mode") != "eval"
    return None if is_refused else (source, where)


def completed(line: CommandLine, conf: Path) -> CommandLine:
    """Add what the words stand for: a folder's experiments, the choices of globs, and the sweep's folder.

    Raises:
        ConfigError: a glob matches nothing. Or the experiments of a sweep have different folders, or a word chooses
            their problem.
    """
    line = _with_globs_written_out(_with_experiments_of_a_folder(line, conf), conf)
    return line.with_words(_sweep_folder(line, conf))


def _with_experiments_of_a_folder(line: CommandLine, conf: Path) -> CommandLine:
    """Write `experiment=FOLDER` out as a sweep over all experiments in it."""
    chosen = line.given().get("experiment")
    if chosen is None or chosen.is_delete() or chosen.is_sweep_override():
        return line
    folder = conf / "experiment" / str(chosen.value())
    if not os.path.isdir(folder):
        return line
    experiments = ",".join(f"{folder.name}/{file.stem}" for file in sorted(folder.glob("*.yaml")))
    line = line.with_replaced({"experiment": f"experiment={experiments}"})
    return replace(line, flags={**line.flags, "multirun": True})


def _with_globs_written_out(line: CommandLine, conf: Path) -> CommandLine:
    """Write `GROUP=glob(...)` out as a sweep over the choices in all folders.

    Raises:
        ConfigError: a glob matches no choice.
    """
    replaced: dict[str, str] = {}
    for override in line.overrides:
        group, pattern = override.key_or_group, override.value()
        if isinstance(pattern, Glob) and line.is_multirun:
            names = sorted({file.stem for folder in (conf, *line.folders) for file in (folder / group).glob("*.yaml")})
            found = pattern.filter(names)
            if not found:
                raise ConfigError(f"{override.input_line}: matches no choice; conf/{group} has {', '.join(names)}")
            replaced[group] = f"{override.get_key_element()}={','.join(found)}"
    return line.with_replaced(replaced)


def _sweep_folder(line: CommandLine, conf: Path) -> list[str]:
    """Return the word that sets the sweep's folder, if all experiments of the sweep name the same one.

    Hydra reads a sweep's folder from the config without swept groups, so from none of the experiments.

    Raises:
        ConfigError: they name different ones. Or a word chooses the problem, although the folders of runs are named
            after those of the experiments.
    """
    given = line.given()
    experiments = given.get("experiment")
    if experiments is None or not (line.is_multirun and experiments.is_discrete_sweep()):
        return []
    if "env" in given:
        raise ConfigError(f"{given['env'].input_line}: the experiments of a sweep choose env themselves; leave it out")
    if "hydra.sweep.dir" in given:
        return []
    folders: dict[str, None] = {}
    try:
        with hydra.initialize_config_dir(str(conf), version_base="1.3"):
            for choice in written_out(experiments):
                cfg = hydra.compose("config", [choice, *line.search_path], return_hydra_config=True)
                settings: Any = OmegaConf.to_container(cfg.hydra.sweep, resolve=False)
                folders[settings["dir"]] = None
    except (HydraException, OmegaConfBaseException):
        return []  # which Hydra will report
    if len(folders) > 1:
        different = f"their sweeps have different folders, {' and '.join(folders)}"
        raise ConfigError(f"{experiments.input_line}: {different}; set hydra.sweep.dir")
    return [f"hydra.sweep.dir='{folder}'" for folder in folders if "${" not in folder]


def written_out(override: Override) -> Iterator[str]:
    """Yield an override for each value of a swept one."""
    if not override.is_discrete_sweep():
        yield override.input_line or ""
        return
    for value in override.sweep_string_iterator():
        yield f"{override.get_key_element()}={value}"
