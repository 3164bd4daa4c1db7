"""What is checked of a yaml file before Hydra reads it."""

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
    """Have every yaml file that Hydra reads checked, from now on in this process."""
    Plugins.instance()  # which registers Hydra's own reader
    SourcesRegistry.instance().types[CheckedYamlFiles.scheme()] = CheckedYamlFiles


class CheckedYamlFiles(FileConfigSource):
    """Hydra's folders of yaml files, of which none takes all memory."""

    def load_config(self, config_path: str) -> Any:
        """Check the file, then read it."""
        check_size(Path(self.path, self._normalize_file_name(config_path)))
        return super().load_config(config_path)


# Hydra in a worker of a launcher refuses a class of another name.
CheckedYamlFiles.__name__ = FileConfigSource.__name__


def check_size(file: Path) -> None:
    """Refuse a file that a few aliases make huge, or that nests too deep. Nothing is expanded for that.

    Raises:
        ConfigError: with the file's name.
    """
    try:
        with file.open("rb") as stream:
            for count, levels in _counted(stream):
                if count > _MOST_VALUES:
                    raise ConfigError(f"{file}: has more than {_MOST_VALUES:,} values")
                if levels > _MOST_LEVELS:
                    raise ConfigError(f"{file}: nests more than {_MOST_LEVELS} levels deep")
    except KeyError as error:
        raise ConfigError(f"{file}: *{error.args[0]} stands for nothing, or is part of itself") from error
    except (yaml.YAMLError, UnicodeDecodeError):
        return  # Hydra tells it with the line


def _counted(stream: Any) -> Iterator[tuple[int, int]]:
    """Yield after each piece of a yaml file how many values and open levels there are.

    Raises:
        KeyError: an alias stands for nothing, or inside what it stands for.
    """
    sizes: dict[str, int] = {}  # of what each anchor stands for
    opened: list[tuple[str | None, int]] = []  # for each open list or mapping its anchor and the number before it
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
