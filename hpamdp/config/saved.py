"""Read the config of a saved run without running code from it, since somebody else may have written it.

Values are text and numbers. Classes come from today's yaml files only. Text such as `${oc.env:HOME}` is not resolved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hpamdp.complaints import as_json
from hpamdp.config.components import GROUPS, RUN_VALUES, TARGET, PlaceOf
from hpamdp.config.compose import check, choosing, compose, is_name, names_of, plain_groups
from hpamdp.config.errors import ConfigError, MissingChoiceError
from hpamdp.config.schema import AgentConfig, Config, EnvConfig
from hpamdp.renamed import with_new_names
from hpamdp.settings import Settings

_CHOICES = "choices"
# Values of the run that earlier versions did not save, with the defaults of the time.
_BEFORE = {"film": True, "callbacks": [], "save_best": False, "compile_updates": False, "update_precision": "float32"}
# Groups that earlier versions did not have, with the choice that does what they did.
_GROUPS_BEFORE = {"encoder": "auto", "exploration": "none"}
_RUN_GROUPS: dict[str, type[Settings]] = {"agent": AgentConfig, "env": EnvConfig}


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
    trust: bool = False,
    file: object = "the saved run",
    place_of: PlaceOf | None = None,
) -> Config:
    """Return a saved config, changed by the given values and checked.

    Args:
        saved: the config as `Config.to_dict` returned it, in this version or an earlier one.
        given: values by their names on the command line, such as `low.lr`. The name of a group stands for all its
            settings and its class.
        names: the names of the groups in `given`.
        trust: whether the saved config may set the `guarded_settings` of a class.
        file: the file of the config.
        place_of: returns where a setting in `given` was set, for errors; None if that is not known.

    Raises:
        ConfigError: a value is wrong, a name has no yaml file in the searched folders, or only `saved` sets a
            guarded setting.
    """
    given, names = given or {}, names or {}
    saved = upgraded(saved)
    groups = [group for group in GROUPS if group not in given]
    choices = {group: saved[_CHOICES][group] for group in groups}
    composed = compose([choosing(group, name) for group, name in choices.items()])
    today = plain_groups(composed, saved, groups, may_lack=True)
    values = {name: value for name, value in saved.items() if name not in (*GROUPS, _CHOICES)}
    for group in groups:
        renamed = with_new_names(group, saved[group], today[group])
        values[group] = {**today[group], **renamed, TARGET: today[group][TARGET]}
    per_option = values.get("low", {}).get("per_option")
    if isinstance(per_option, Mapping):
        values["low"]["per_option"] = {option: _with_new_names(choice) for option, choice in per_option.items()}
    for name, value in given.items():
        _set(values, name.split("."), value)

    def place_of_given(setting: str) -> str | None:
        is_given = any(setting == name or setting.startswith(f"{name}.") for name in given)
        return place_of(setting) if is_given and place_of is not None else None

    config = check(values, {**choices, **names}, place_of_given)
    found = {} if trust else _guarded(config, saved, today, given)
    if found:
        settings = ", ".join(f"{setting}={as_json(value)}" for setting, value in found.items())
        raise ConfigError(
            f"{settings}: set by {file}, and can run code, read files or reach servers; set {' and '.join(found)} on "
            "the command line, or add trust=true if you trust the file; in Python, give env or trust=True"
        )
    return config


def _with_new_names(choice: Any) -> Any:
    """Return a choice of `low.per_option` with today's names of its settings."""
    if not isinstance(choice, Mapping) or not is_name(choice.get("name")):
        return choice
    try:
        known = plain_groups(compose([choosing("low", choice["name"])]), {}, ["low"])["low"]
    except MissingChoiceError:  # the check of the config reports it
        return choice
    return with_new_names("low", choice, known)


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
        for callback, choice in zip(config.callbacks, saved["callbacks"], strict=True)
        for name, value in (choice.items() if isinstance(choice, Mapping) else ())
    ):
        found["callbacks"] = saved["callbacks"]
    return found


def upgraded(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return a saved config in the form that `Config.to_dict` has today, with defaults for missing values.

    Raises:
        ConfigError: `saved` is no config of this program.
    """
    new_groups = {group: name for group, name in _GROUPS_BEFORE.items() if group not in saved}
    saved = {**saved, **{group: {} if _CHOICES in saved else {"name": name} for group, name in new_groups.items()}}
    for group in GROUPS:
        if not isinstance(saved.get(group), Mapping):
            raise ConfigError(f"the saved config has no {group}; it is damaged, or another program wrote it")
    values = dict(saved) if _CHOICES in saved else _from_first_form(saved)
    choices = values[_CHOICES]
    if isinstance(choices, Mapping):
        choices = values[_CHOICES] = {**new_groups, **choices}
    for group in GROUPS:
        name = choices.get(group) if isinstance(choices, Mapping) else None
        if not is_name(name):
            raise ConfigError(f"the saved config chose {group}={as_json(name)}, which is no name of a yaml file")
    values.pop("trust", None)
    for group, entries in _RUN_GROUPS.items():
        if isinstance(values.get(group), Mapping):
            values[group] = with_new_names(group, values[group], entries.model_fields)
    return {**_BEFORE, **values}


def _from_first_form(saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config of an earlier version, in which a group's entry `name` is its choice, in today's form.

    If the class has a setting `name`, that value replaced the choice. Then the group's other settings identify it.
    """
    choices, groups = {}, {}
    for group in GROUPS:
        groups[group] = {name: value for name, value in saved[group].items() if name != "name"}
        choices[group] = saved[group].get("name")
    known = _settings_of(choices)
    for group, settings in groups.items():
        groups[group] = settings = with_new_names(group, settings, known[group])
        if "name" in known[group] or not settings.keys() <= known[group]:
            for name in names_of(group):
                its_own = _settings_of({group: name})[group]
                if "name" in its_own and saved[group].keys() <= its_own:
                    choices[group], groups[group] = name, dict(saved[group])
    return {**saved, **groups, _CHOICES: choices}


def _settings_of(choices: Mapping[str, Any]) -> dict[str, set[str]]:
    """Return the possible entries of each group: the settings of its yaml file and the values of the run."""
    of_any = {group: {*RUN_VALUES.get(group, ())} for group in choices}
    try:
        if all(map(is_name, choices.values())):
            cfg = compose([choosing(group, name) for group, name in choices.items()])
            return {group: of_any[group] | {str(name) for name in cfg[group]} for group in choices}
    except MissingChoiceError:
        pass
    if len(choices) == 1:
        return of_any
    return {group: _settings_of({group: name})[group] for group, name in choices.items()}


def _set(values: dict[str, Any], path: Sequence[str], value: Any) -> None:
    """Set a nested value, and copy the mappings that contain it."""
    *outer, last = path
    for name in outer:
        inner = values.get(name)
        values[name] = dict(inner) if isinstance(inner, Mapping) else {}
        values = values[name]
    values[last] = value
