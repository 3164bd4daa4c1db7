"""Check yaml files before Hydra reads them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins

from hpamdp.config import ConfigError

_MOST_VALUES, _MOST_LEVELS = 100_000, 50
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def check_before_hydra_reads() -> None:
    """Check every yaml file that Hydra reads in this process from now on."""
    Plugins.instance()  # which registers Hydra's own reader
    SourcesRegistry.instance().types[CheckedYamlFiles.scheme()] = CheckedYamlFiles


class CheckedYamlFiles(FileConfigSource):
    """Hydra's reader of yaml files, which refuses a file that would fill the memory."""

    def load_config(self, config_path: str) -> Any:
        """Check the file, then read it."""
        check_size(Path(self.path, self._normalize_file_name(config_path)))
        return super().load_config(config_path)


# In a launcher's worker Hydra refuses a reader with another name.
CheckedYamlFiles.__name__ = FileConfigSource.__name__


def check_size(file: Path) -> None:
    """Refuse a file that a few aliases make huge, or that nests too deep. Aliases are counted, not expanded.

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
        return  # Hydra reports these errors with the line


def _counted(stream: Any) -> Iterator[tuple[int, int]]:
    """Yield the numbers of values so far and of open levels after each event of a yaml file.

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
