"""Read the config of a saved run without running code from it, since somebody else may have written it.

Values are text and numbers. Classes come from today's yaml files only. Text such as `${oc.env:HOME}` is not resolved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from omegaconf import DictConfig

from hpamdp.complaints import as_json
from hpamdp.config.components import GROUPS, TARGET, card_named, defaults_of, model_of
from hpamdp.config.compose import check, choosing, chosen_names, compose, is_name, plain_groups
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import AgentConfig, Config
from hpamdp.renamed import with_new_names

_CHOICES = "choices"


def choices_of(saved: Mapping[str, Any]) -> dict[str, str]:
    """Return the name that a saved config chose for each group.

    Raises:
        ConfigError: `saved` is no config of this program.
    """
    choices = upgraded(saved)[_CHOICES]
    return {group: choices[group] for group in GROUPS}


def read_saved(
    saved: Mapping[str, Any],
    given: Mapping[str, Any] | None = None,
    names: Mapping[str, str] | None = None,
    *,
    composed: DictConfig | None = None,
    trust: bool = False,
    file: object = "the saved run",
) -> Config:
    """Return a saved config, changed by the given values and checked.

    Args:
        saved: the config as `Config.to_dict` returned it, in this version or an earlier one.
        given: values by their names on the command line, such as `low.lr`. The name of a group stands for all its
            settings and its class.
        names: the names of the groups in `given`.
        composed: a config with today's yaml files of the saved choices. If it has other choices, or is None, the files
            are composed once more, which takes a quarter of a second.
        trust: whether the saved config may set the `guarded_settings` of a class.
        file: the file of the config.

    Raises:
        ConfigError: a value is wrong, a name has no yaml file in the searched folders, or only `saved` sets a
            guarded setting.
    """
    given, names = given or {}, names or {}
    saved = upgraded(saved)
    groups = [group for group in GROUPS if group not in given]
    choices = {group: saved[_CHOICES][group] for group in groups}
    if composed is None or not choices.items() <= dict(chosen_names(composed)).items():
        composed = compose([choosing(group, name) for group, name in choices.items()])
    today = plain_groups(composed, saved, groups, may_lack=True)
    values = {name: value for name, value in saved.items() if name not in (*GROUPS, _CHOICES)}
    for group in groups:
        own = with_new_names(group, saved[group], today[group])
        values[group] = {
            **today[group],
            **_later_defaults(group, today[group], own),
            **own,
            TARGET: today[group][TARGET],
        }
    for name, value in given.items():
        _set(values, name.split("."), value)
    config = check(values, {**choices, **names})
    found = {} if trust else _guarded(config, saved, today, given)
    if found:
        settings = ", ".join(f"{setting}={as_json(value)}" for setting, value in found.items())
        raise ConfigError(
            f"{settings}: set by {file}, and can run code, read files or reach servers; set {' and '.join(found)} on "
            "the command line, or add trust=true if you trust the file; in Python, give env or trust=True"
        )
    return config


def _later_defaults(group: str, today: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return the defaults of the settings that the saved run did not have yet, whatever today's recipe takes."""
    target = str(today[TARGET])
    later = today.keys() - own.keys()
    if not later or card_named(target) is None:
        return {}
    return {name: value for name, value in defaults_of(model_of(target, group)).items() if name in later}


def needs_trust(config: Config) -> bool:
    """Return whether continuing a run of this config may need `trust=true`, because a guarded setting is not null."""
    parts = [getattr(config, group) for group in GROUPS if group != "data"] + [
        *config.low_of.values(),
        *config.callbacks,
    ]
    settings = [(part, name, value) for part in parts for name, value in part.settings.items()]
    return any(value is not None and part.is_guarded(name, value) for part, name, value in settings)


def _guarded(
    config: Config, saved: Mapping[str, Any], today: Mapping[str, Mapping[str, Any]], given: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the guarded settings that only the saved config sets."""
    found = {}
    for group, ours in today.items():
        for name, value in saved[group].items():
            setting = f"{group}.{name}"
            if setting not in given and value != ours.get(name) and getattr(config, group).is_guarded(name, value):
                found[setting] = value
    for option, low in config.low_of.items():
        choice = (saved["low"].get("per_option") or {}).get(option)
        for name, value in choice.items() if isinstance(choice, Mapping) else ():
            if low.is_guarded(name, value):
                found[f"low.per_option.{option}.{name}"] = value
    if "callbacks" not in given and any(
        callback.is_guarded(name, value)
        for callback, choice in zip(config.callbacks, saved.get("callbacks", ()), strict=True)
        for name, value in (choice.items() if isinstance(choice, Mapping) else ())
    ):
        found["callbacks"] = saved["callbacks"]
    return found


def upgraded(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return a saved config in the form that `Config.to_dict` has today.

    Raises:
        ConfigError: `saved` is no config of this program.
    """
    for part in (*GROUPS, _CHOICES):
        if not isinstance(saved.get(part), Mapping):
            raise ConfigError(f"the saved config has no {part}; it is damaged, or another program wrote it")
    for group in GROUPS:
        name = saved[_CHOICES].get(group)
        if not is_name(name):
            raise ConfigError(f"the saved config chose {group}={as_json(name)}, which is no name of a yaml file")
    values = {name: value for name, value in saved.items() if name != "trust"}
    if isinstance(values.get("agent"), Mapping):
        values["agent"] = with_new_names("agent", values["agent"], AgentConfig.model_fields)
    return values


def _set(values: dict[str, Any], path: Sequence[str], value: Any) -> None:
    """Set a nested value, and copy the mappings that contain it."""
    *outer, last = path
    for name in outer:
        inner = values.get(name)
        values[name] = dict(inner) if isinstance(inner, Mapping) else {}
        values = values[name]
    values[last] = value
