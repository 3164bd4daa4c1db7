"""Explain Hydra's errors about a command line or a yaml file in one line."""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from hpamdp.complaints import close_names, no_such
from hpamdp.config.command_line import SEARCH, CommandLine, as_text, choices_in, written_out
from hpamdp.config.components import GROUPS, TARGET
from hpamdp.config.compose import NESTED, beginning_of
from hpamdp.config.schema import RUN_FILE
from hpamdp.messages import file_and_reason, first_line
from hpamdp.renamed import elsewhere, renamed

# Launchers in separate packages, and the extra of pyproject.toml that installs each.
_LAUNCHER = "hydra/launcher"
_EXTRAS = {"joblib": "joblib", "submitit_local": "slurm", "submitit_slurm": "slurm", "ray": "ray-launcher"}


# Errors that Hydra raises for a wrong command line or yaml file.
BEFORE_A_JOB = (HydraException, OmegaConfBaseException, yaml.YAMLError, OSError, ValueError, RecursionError)


def explained(error: Exception, line: CommandLine, conf: Path) -> str:
    """Return the mistake in the command line or the yaml files in one line, given Hydra's error."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        return _missing_choice(error.missing_cfg_file, error.options, conf)
    if not isinstance(error, HydraException | OmegaConfBaseException):
        return _first_lines(error, line.words)
    for override in line.overrides:
        if override.is_sweep_override() and not line.is_multirun:
            several = f"{override.input_line}: several values; add --multirun to run them all, or put a list in [ ]"
            return f"{several}; for one text write {as_text(override.input_line or '')}"
    return _wrong_setting(line, conf) or _first_lines(error, line.words)


def _missing_choice(file: str, there: Sequence[str], conf: Path) -> str:
    group, _, name = file.rpartition("/")
    if group == _LAUNCHER:
        if name in _EXTRAS:
            return f"{group}={name}: not installed; pip install 'hpamdp[{_EXTRAS[name]}]'"
        there = (*there, *_EXTRAS)
    if not group.startswith("hydra"):  # a folder of a group may be part of the choice
        group, _, name = file.partition("/")
    if name and os.path.isdir(conf / group / name):
        inside = [each for each in choices_in(conf / group) if each.startswith(f"{name}/")]
        return f"{group}={name}: a folder; choose one of {', '.join(inside)}"
    return f"{group}={name}: {no_such('choice', name, {*there, *choices_in(conf / group)}, where=f'conf/{group}')}"


def _first_lines(error: Exception, words: Sequence[str]) -> str:
    """Return the place of an error in a yaml file, or the messages of an error and its cause, in one line."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f"{error.problem_mark.name}, line {error.problem_mark.line + 1}: {error.problem}"
    if isinstance(error, OSError):
        return file_and_reason(error)
    if isinstance(error, RecursionError | ValueError) and not isinstance(error, OmegaConfBaseException):
        return beginning_of(words) + (NESTED if isinstance(error, RecursionError) else first_line(error))
    causes = [error] if error.__cause__ is None else [error, error.__cause__]
    lines = [first_line(cause).rstrip(".") for cause in causes]
    if lines[0].endswith(":"):
        lines[:1] = [lines[0].rstrip(":"), first_line(str(error).partition("\n")[2])]
    return ": ".join(dict.fromkeys(line for line in lines if line)) or type(error).__name__


def _wrong_setting(line: CommandLine, conf: Path) -> str | None:
    """Return a message about the first override of a setting that is not in the config; None if there is none."""
    overrides = line.overrides
    groups = [o for o in overrides if "/" in o.key_or_group or os.path.isdir(conf / o.key_or_group)]
    others = [o for o in overrides if o not in groups and not o.is_add() and not o.is_force_add()]
    for choices in itertools.product(*map(written_out, groups)):
        try:
            with hydra.initialize_config_dir(str(conf), version_base="1.3"):
                cfg = hydra.compose("config", [*line.search_path, *choices], return_hydra_config=True)
        except (HydraException, OmegaConfBaseException):
            return None
        for override in others:
            wrong = missing_setting(cfg, override.key_or_group, conf)
            if wrong is not None:
                return wrong
    return None


def missing_setting(cfg: DictConfig, setting: str, conf: Path) -> str | None:
    """Return a message that a setting with a dotted name is not in the config; None if it is."""
    names = setting.split(".")
    node: Any = OmegaConf.to_container(OmegaConf.masked_copy(cfg, names[0]) if names[0] in [*cfg] else cfg)
    for depth, name in enumerate(names):
        if not isinstance(node, dict):
            return None
        if name not in node:
            known = [each for each in node if each not in (TARGET, "budget")]
            return f"{setting}: {renamed(setting, known) or _no_such_setting(cfg, names[:depth], name, known, conf)}"
        node = node[name]
    return None


def _in_groups(cfg: DictConfig, name: str) -> list[str]:
    """Return the settings of groups, such as `env.max_steps`, that have a name, or else one close to it."""
    settings = {group: [*cfg[group]] for group in GROUPS if isinstance(cfg.get(group), DictConfig)}
    exact = [f"{group}.{name}" for group, names in settings.items() if name in names]
    return exact or [
        f"{group}.{each}"
        for group, names in settings.items()
        for each in elsewhere(name, names) or close_names(name, names)
    ]


def _no_such_setting(cfg: DictConfig, path: list[str], name: str, known: list[str], conf: Path) -> str:
    if not path:
        folders = {folder.name for folder in conf.iterdir() if folder.is_dir()}
        names = sorted({*known, *folders} - {"hydra", SEARCH})
        guesses = elsewhere(name, names) or close_names(name, names) or _in_groups(cfg, name)
        return no_such(f"group or value of the run ({RUN_FILE})", name, names, guesses=guesses)
    if len(path) == 1 and path[0] in GROUPS:
        group, target = path[0], OmegaConf.to_container(cfg[path[0]]).get(TARGET)  # type: ignore[union-attr]
        if target is None:
            return f"{group}={cfg.hydra.runtime.choices[group]} has no settings; choose another {group}, too"
        return no_such(f"setting of {str(target).rpartition('.')[2]}", name, known)
    return no_such(f"value of {'.'.join(path)}", name, known)
