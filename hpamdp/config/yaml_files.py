"""Give Hydra the yaml files of a folder together with the default settings of their classes.

The composed config then has all settings. The command line can override them, `--cfg job` shows them, and other yaml
files can refer to them. Importing this module registers two plugins with Hydra: a source of configs for paths with the
scheme `hpamdp`, and a search path that reads the folder of the main config from this source.
"""

from __future__ import annotations

from typing import Any

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from hpamdp.config.components import (
    CALLBACK,
    GROUPS,
    TARGET,
    USUAL_LEARNER,
    defaults_of,
    model_of,
)
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import RunConfig

SCHEME = "hpamdp"
_plugins = Plugins.instance()
# Hydra's own source of yaml files in a folder.
_FileSource: Any = next(each for each in _plugins.discover(ConfigSource) if each.scheme() == "file")  # type: ignore[attr-defined]


class CompletedFiles(_FileSource):
    """The yaml files of a folder, completed by the default settings of their classes."""

    @staticmethod
    def scheme() -> str:
        """Return what precedes `://` in paths of this source."""
        return SCHEME

    def load_config(self, config_path: str) -> ConfigResult:
        """Read a yaml file, and add settings that it does not give, and the default learner of a user's problem."""
        result: ConfigResult = super().load_config(config_path)
        given = result.config
        if isinstance(given, DictConfig):
            defaults = [*(given.get("defaults") or [])]
            extends_none = all(each == "_self_" for each in defaults)
            is_own_problem = self.provider != "main" and config_path.startswith("env/")
            learner = {"defaults": [*defaults, *USUAL_LEARNER["defaults"]]} if is_own_problem and extends_none else {}
            result.config = OmegaConf.merge(_defaults(config_path, given), given, learner)
        return result


class CompletedMain(SearchPathPlugin):
    """Reads the folder of the main config with the default settings of classes."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Change the scheme of the main folder's path."""
        for each in search_path.get_path():
            if each.provider == "main":
                each.path = completed_path(each.path)


_plugins.register(CompletedFiles)
_plugins.register(CompletedMain)


def completed_path(path: str) -> str:
    """Return the path of a folder, with or without `file://`, such that Hydra adds the default settings of classes."""
    return path if "://" in path.removeprefix("file://") else f"{SCHEME}://{path.removeprefix('file://')}"


def _defaults(config_path: str, cfg: DictConfig) -> dict[str, Any]:
    """Return the default settings of a yaml file's class, or of the run."""
    if config_path.removesuffix(".yaml") == "config":
        return defaults_of(RunConfig)
    group = config_path.partition("/")[0]
    written: Any = OmegaConf.to_container(cfg, resolve=False)
    target = written.get(TARGET) if group in (*GROUPS, CALLBACK) else None
    if not isinstance(target, str):
        return {}
    try:
        return defaults_of(model_of(target, group))
    except ConfigError:  # which the check of the config raises again, with the name of the file
        return {}
