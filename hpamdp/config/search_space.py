"""Which values a search tries for a setting, in the grammar that sweeps have on the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import yaml
from hydra.core.override_parser.types import Override, QuotedString

from hpamdp.complaints import no_such
from hpamdp.config.command_line import SEARCH, choices_in, parsed_words
from hpamdp.config.compose import conf_dir
from hpamdp.config.errors import ConfigError


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`, both included; `step` apart if they are whole."""

    low: float
    high: float
    step: int = 1
    is_log: bool = False


Space = dict[str, Range | list[Any]]


def space_of_learner(name: str, given: Sequence[str]) -> dict[str, str]:
    """Return the space of `conf/search` for a learner, as texts, without the settings that are given.

    Raises:
        ConfigError: there is none for this learner.
    """
    folder = conf_dir() / SEARCH
    file = folder / f"{name}.yaml"
    if not file.is_file():
        raise ConfigError(f"low={name}: {no_such('search space', name, choices_in(folder))}; give a space of your own")
    space = yaml.safe_load(file.read_text())
    return {setting: str(values) for setting, values in space.items() if setting not in given}


def parsed_space(given: Mapping[str, Any]) -> Space:
    """Return a space whose values are texts such as `tag(log, interval(1e-4, 1e-2))` or `2,5,10`, or lists.

    Raises:
        ConfigError: a text cannot be understood, or has one value.
    """
    space: Space = {name: [*values] for name, values in given.items() if isinstance(values, list | tuple)}
    overrides = _parsed([f"{name}={values}" for name, values in given.items() if name not in space])
    return space | {_name(override): _values(override) for override in overrides}


def split_words(words: Sequence[str]) -> tuple[dict[str, Any], Space]:
    """Return the settings among a command line's words as Python's values, and the space: those with several values.

    Raises:
        ConfigError: a word cannot be understood.
    """
    overrides = _parsed(words)
    settings = {_name(each): _plain(each.value()) for each in overrides if not each.is_sweep_override()}
    return settings, {_name(each): _values(each) for each in overrides if each.is_sweep_override()}


def _parsed(words: Sequence[str]) -> tuple[Override, ...]:
    overrides = parsed_words(words)
    deleted = next((each for each in overrides if each.is_delete()), None)
    if deleted is not None:
        raise ConfigError(f"{deleted.input_line}: a search gives settings values; leave it out")
    return overrides


def _name(override: Override) -> str:
    return f"{'+' if override.is_add() else ''}{override.key_or_group}"


def _values(override: Override) -> Range | list[Any]:
    if not override.is_sweep_override():
        raise ConfigError(f"{override.input_line}: one value; write interval(LOW,HIGH), range(LOW,HIGH) or choice(A,B)")
    value: Any = override.value()
    is_log = "log" in value.tags
    if override.is_interval_sweep():
        return Range(value.start, value.end, is_log=is_log)
    listed = [_plain(each) for each in override.sweep_iterator()]
    is_plain_range = override.is_range_sweep() and all(isinstance(each, int) for each in listed) and not value.shuffle
    return Range(listed[0], listed[-1], int(value.step), is_log) if is_plain_range and len(listed) > 1 else listed


def _plain(value: Any) -> Any:
    """Return a value without the quotes that Hydra's grammar keeps."""
    if isinstance(value, QuotedString):
        return value.text
    if isinstance(value, Mapping):
        return {_plain(name): _plain(each) for name, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list) else value
