"""Write the page of `--help` from the yaml files and the settings models."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from hpamdp.config.command_line import SEARCH, CommandLine, choices_in
from hpamdp.config.components import CALLBACK, GROUPS, component, model_of
from hpamdp.config.compose import listed_callbacks, plain
from hpamdp.config.errors import ConfigError
from hpamdp.config.outside_jobs import composed
from hpamdp.config.schema import RunConfig
from hpamdp.settings import meanings_of
from hpamdp.shell import program

_WIDTH = 110  # letters of a line
_PAGE = """\
hpamdp trains and scores two-level agents on parameterised-action MDPs: a selector (high) chooses an option; a learner
(low) chooses a discrete action and its parameters at every step.

Usage: {program} [GROUP=CHOICE ...] [GROUP.SETTING=VALUE ...] [VALUE=... ...] [--multirun]

Groups and their choices
{groups}

{chosen}Values of the run, with their defaults
{values}

Examples
  {program} low=pdqn --help                         explains the settings of a choice, too
  {program} high=ucb low=hyar                       trains; the results go to a folder of their own in outputs/
  {program} mode=eval checkpoint=FOLDER             scores the agent of an earlier run
  {program} --multirun high=ucb,uniform seed=0,1    four runs one after another, in multirun/; docs/sweeps.md has more
  {program} low=hyar --cfg job                      shows every value and setting without running
  {program} --hydra-help                            shows Hydra's own flags

Further commands, each with its own --help
  {program} play            lets you play the problem yourself
  {program} watch FOLDER    films the agent of a run
  {program} report FOLDER   compares the runs in a folder by their means over seeds
  {program} judge FOLDER... orders agents by recorded actions, without their problem
  {program} tune low=hppo   searches for good settings with Optuna
"""


def help_page(line: CommandLine, conf: Path) -> str:
    """Return the text of `--help`, which explains the settings of each choice on the command line.

    Raises:
        ConfigError: the command line cannot be composed.
    """
    folders = {folder.name: choices_in(folder) for folder in sorted(conf.iterdir()) if folder.is_dir()}
    folders.pop(SEARCH)
    groups = [
        textwrap.fill(f"{name:<12}{', '.join(choices)}", _WIDTH, initial_indent="  ", subsequent_indent=" " * 14)
        for name, choices in folders.items()
    ]
    return _PAGE.format(
        program=program(),
        groups="\n".join(groups),
        chosen="".join(_explained_choices(line)),
        values="\n".join(_explained(RunConfig, "", {})),
    )


def _explained_choices(line: CommandLine) -> Iterator[str]:
    """Yield the settings of each choice on the command line."""
    groups = [group for group in line.given() if group in GROUPS]
    has_callbacks = "callbacks" in line.given()
    if groups or has_callbacks:
        words = [word for word in line.words if not word.startswith("hydra.")]
        with composed([*words, *line.search_path]) as cfg:
            for group in groups:
                name = str(cfg.hydra.runtime.choices[group])
                yield _explained_choice(group, name, plain(cfg[group], group), f"{group}.")
            if has_callbacks:
                for name, given in listed_callbacks(plain(OmegaConf.masked_copy(cfg, "callbacks"))["callbacks"], {}):
                    yield _explained_choice(CALLBACK, name, given, "")


def _explained_choice(group: str, name: str, given: Mapping[str, Any], prefix: str) -> str:
    try:
        chosen = component(group, name, given)
    except ConfigError:
        return ""
    if not chosen.settings:
        return f"{group}={name} has no settings\n\n"
    assert chosen.target is not None
    lines = _explained(model_of(chosen.target, group), prefix, dict(chosen.settings))
    return "\n".join([f"Settings of {group}={name}", *lines, "", ""])


def _explained(model: type[BaseModel], prefix: str, values: dict[str, Any]) -> Iterator[str]:
    """Yield a line with each setting and its value, and its meaning below."""
    meanings = meanings_of(model)
    for name, field in model.model_fields.items():
        default = values.get(name, field.default)
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _explained(field.annotation, f"{prefix}{name}.", {})
            continue
        shown = "" if default is PydanticUndefined else json.dumps(default, default=str)
        yield f"  {prefix}{name}={shown}"
        meaning = " ".join(meanings.get(name, "").split())
        yield textwrap.fill(meaning, _WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6)
