"""Add the default settings of their classes to yaml files when Hydra reads them."""

from __future__ import annotations

from typing import Any

from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import DictConfig, Node, OmegaConf

from hpamdp.config.components import (
    CALLBACK,
    GROUPS,
    TARGET,
    defaults_of,
    model_of,
)
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import RunConfig


def complete_yaml_files() -> None:
    """Have Hydra's reader add the defaults of missing settings.

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
        return defaults_of(model_of(target._value(), group))
    except ConfigError:  # which the check of the config raises again, with the name of the file
        return {}
