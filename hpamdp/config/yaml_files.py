"""Check yaml files when Hydra reads them, and add the default settings of their classes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import yaml
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import DictConfig, Node, OmegaConf

from hpamdp.config.components import (
    CALLBACK,
    GROUPS,
    SUPPLIED_ARGUMENTS,
    TARGET,
    defaults_of,
    load_class,
    settings_model,
)
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import RunConfig
from hpamdp.config.stand_ins import quick_imports, works_with_stand_ins

_MOST_VALUES, _MOST_LEVELS = 100_000, 50
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def complete_yaml_files() -> None:
    """Have Hydra's reader refuse files that would fill the memory, and add the defaults of missing settings.

    The composed config then has all settings. The command line can override them, `--cfg job` shows them, and other
    yaml files can refer to them.
    """
    readers: list[Any] = [each for each in Plugins.instance().discover(ConfigSource) if each.scheme() == "file"]  # type: ignore[attr-defined]
    for reader in readers:
        if not hasattr(reader, "load_alone"):
            reader.load_alone = reader.load_config
            reader.load_config = _load_complete


def _load_complete(reader: Any, config_path: str) -> ConfigResult:
    """Read a yaml file; replaces the method `load_config` of Hydra's reader."""
    check_size(Path(reader.path, reader._normalize_file_name(config_path)))
    result: ConfigResult = reader.load_alone(config_path)
    if isinstance(result.config, DictConfig):
        result.config = OmegaConf.merge(_defaults(config_path, result.config), result.config)
    return result


def _defaults(config_path: str, cfg: DictConfig) -> dict[str, Any]:
    """Return the default settings of a yaml file's class, or of the run."""
    if config_path.removesuffix(".yaml") == "config":
        return defaults_of(RunConfig)
    group = config_path.partition("/")[0]
    target = cfg._get_node(TARGET) if group in (*GROUPS, CALLBACK) else None  # as it is written, not resolved
    if not isinstance(target, Node) or not isinstance(target._value(), str):
        return {}
    try:
        with quick_imports() if works_with_stand_ins(target._value()) else nullcontext():
            return defaults_of(settings_model(load_class(target._value()), SUPPLIED_ARGUMENTS.get(group, ())))
    except ConfigError:  # which the check of the config raises again, with the name of the file
        return {}


def check_size(file: Path) -> None:
    """Refuse a file that nests too deep or holds too many values; aliases are counted, not expanded.

    Raises:
        ConfigError: the message names the file.
    """
    try:
        with file.open("rb") as stream:
            for count, levels in _counted(stream):
                if count > _MOST_VALUES:
                    raise ConfigError(f"{file}: has more than {_MOST_VALUES:,} values")
                if levels > _MOST_LEVELS:
                    raise ConfigError(f"{file}: nests more than {_MOST_LEVELS} levels deep")
    except KeyError as error:
        raise ConfigError(f"{file}: *{error.args[0]} refers to nothing, or to a value that contains it") from error
    except (yaml.YAMLError, UnicodeDecodeError):
        return  # Hydra reads the file next, and reports the error with its line


def _counted(stream: Any) -> Iterator[tuple[int, int]]:
    """Yield the number of values so far and the number of open levels after each event of a yaml file.

    Raises:
        KeyError: an alias refers to nothing, or to a value that contains it.
    """
    sizes: dict[str, int] = {}  # number of values under each anchor
    opened: list[tuple[str | None, int]] = []  # each open list's or mapping's anchor, and the values before it
    count = 0
    for event in yaml.parse(stream, Loader=_LOADER):
        if isinstance(event, yaml.AliasEvent):
            count += sizes[str(event.anchor)]
        elif isinstance(event, yaml.CollectionStartEvent):
            opened.append((event.anchor, count))
            count += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = opened.pop()
            if anchor is not None:
                sizes[anchor] = count - before
        elif isinstance(event, yaml.ScalarEvent):
            count += 1
            if event.anchor is not None:
                sizes[event.anchor] = 1
        yield count, len(opened)
