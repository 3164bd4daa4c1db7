"""Check and build the classes that are chosen for the groups of conf/.

A class lists its settings in a model, `Options`. If it has none, its constructor's arguments define the settings. The
settings and the card of this package's classes are read without importing the classes, which would import torch, see
`card_named`. Classes of others are imported.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, get_type_hints

from pydantic import BaseModel, ConfigDict, PydanticUserError, create_model

from hpamdp import cards
from hpamdp.config.errors import ConfigError, validated
from hpamdp.messages import first_line
from hpamdp.settings import SettingError, Settings

# Arguments that the run supplies to the constructor of a group's class. All others are settings.
SUPPLIED_ARGUMENTS: dict[str, tuple[str, ...]] = {
    "env": ("num_envs", "device", "seed", "first_env", "oracle", "human", "make", "flatten_pictures"),
    "high": ("specs", "device"),
    "low": ("specs", "device"),
    "encoder": ("entry",),
    "exploration": ("learner", "device"),
    "data": ("env",),
    "logger": ("output_dir", "config", "earlier"),
    "collector": ("config", "parts", "frames"),
}
# The groups of conf/ in which a class is chosen.
GROUPS = tuple(SUPPLIED_ARGUMENTS)
# The group of conf/ whose classes are listed in a value of the run, `callbacks`.
CALLBACK = "callback"
TARGET = "_target_"
# Defaults list of a user's problem: H-PPO learns it unless `low` is given.
USUAL_LEARNER: dict[str, Any] = {"defaults": [{"override /low@_global_.low": "hppo"}]}
# Values of a group that the run reads itself. The group's class does not get them.
RUN_VALUES: dict[str, tuple[str, ...]] = {
    "low": ("budget", "checkpoint", "freeze", "per_option"),
    "env": ("grouping",),
    CALLBACK: ("name",),
}
# The base class that a group's classes must have, and their card. If the base is a protocol, a class needs its methods.
_BASES: dict[str, tuple[str, type[cards.Card]]] = {
    "env": ("hpamdp.env.base.PAMDPEnv", cards.ProblemCard),
    "high": ("hpamdp.policies.base.Selector", cards.SelectorCard),
    "low": ("hpamdp.policies.base.Learner", cards.LearnerCard),
    "encoder": ("hpamdp.policies.encoders.base.Encoder", cards.EncoderCard),
    "exploration": ("hpamdp.policies.exploration.base.Exploration", cards.ExplorationCard),
    "data": ("hpamdp.data.demonstrations.Demonstrations", cards.DataCard),
    "logger": ("hpamdp.run.loggers.Logger", cards.LoggerCard),
    "collector": ("hpamdp.run.collection.base.Collection", cards.CollectorCard),
    CALLBACK: ("hpamdp.run.callbacks.Callback", cards.CallbackCard),
}
_CAN_BE_NONE = ("high", "exploration", "data")
_STRICT = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False, protected_namespaces=())


@dataclass(frozen=True)
class Component:
    """A class that was chosen for a group, with its settings.

    Attributes:
        group: the group, such as `low`.
        name: name of the yaml file, such as `hyar`.
        target: the class, as its dotted name if it is one of this package, which is imported when it is built; None for
            `high=none`, `exploration=none` and `data=none`.
        settings: checked values by name.
        objects: further arguments of the constructor, from Python code. No file holds them.
        options: the settings as a checked instance of the class's `Options`; None if it has none.
    """

    group: str
    name: str
    target: str | type | None
    settings: Mapping[str, Any]
    objects: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    options: Any = dataclasses.field(default=None, compare=False)

    def __str__(self) -> str:
        return f"{self.group}={self.name}"

    @property
    def cls(self) -> type | None:
        """The class, imported if it has not been; None if there is none."""
        return load_class(self.target) if isinstance(self.target, str) else self.target

    @property
    def class_name(self) -> str:
        """The name of the class, without its module."""
        return _name_of(self.target)

    @property
    def card(self) -> Any:
        """What the class declares; if it has no card or there is no class, an empty card."""
        card = card_named(self.target) if isinstance(self.target, str) else getattr(self.target, "card", None)
        return card or _BASES[self.group][1]()

    def with_settings(self, settings: Mapping[str, Any]) -> Component:
        """Return the component with other, allowed settings."""
        options = None if self.options is None else type(self.options)(**settings)
        return dataclasses.replace(self, settings=settings, options=options)

    def is_guarded(self, name: str, value: object) -> bool:
        """Return whether a saved config needs the user's permission to give a setting this value.

        The card of the class lists such settings, see `Card.guarded_settings`.
        """
        guarded = self.card.guarded_settings
        if value in self.card.unguarded_values.get(name, ()):
            return False
        return name in guarded or f"{name}={value}" in guarded

    def build(self, **context: Any) -> Any:
        """Build the object, or return None if there is no class.

        Args:
            context: objects that the program supplies. The constructor gets those among its arguments.

        Raises:
            ConfigError: the constructor raises a `SettingError`.
        """
        cls = self.cls
        if cls is None:
            return None
        accepted = constructor_arguments(cls)
        supplied = {name: value for name, value in {**context, **self.objects}.items() if name in accepted}
        settings = self.settings if self.options is None else {"options": self.options}
        try:
            return cls(**supplied, **settings)
        except SettingError as error:
            what, name = first_line(error), self.class_name
            raise ConfigError(f"{self.group}: {what}" if name in what else f"{self.group}: {what} ({name})") from error

    def build_for_entry(self, entry: Any) -> Any:
        """Build an encoder for an entry of the observation; as `build`."""
        return self.build(entry=entry)


def component(group: str, name: str, given: Mapping[str, Any], prefix: str = "") -> Component:
    """Check the class and the settings of a group without building the object.

    Args:
        group: the group, such as `low`.
        name: name of the chosen yaml file.
        given: the group's part of the config as plain values, with its `_target_`.
        prefix: what precedes the name of a setting in messages; by default the group and a dot.

    Raises:
        ConfigError: a class or a setting is wrong; the message lists all mistakes in one line.
    """
    of_run = RUN_VALUES.get(group, ())
    settings = {setting: value for setting, value in given.items() if setting not in (TARGET, *of_run)}
    file = file_of(group, name)
    target = given.get(TARGET)
    if target is None and group in _CAN_BE_NONE:
        model = create_model("none", __config__=_STRICT)
        validated(model, settings, f"{group}.", "setting of none", f"none, {file}")
        return Component(group, name, None, {})
    chosen = str(target) if card_named(str(target)) is not None else _load_target(group, target, file)
    model = model_of(chosen, group)
    taken = [value for value in (TARGET, *of_run) if value in model.model_fields]
    if taken:
        raise ConfigError(
            f"{group}={name}: {_name_of(chosen)} has a setting {taken[0]}, but {group}.{taken[0]} is a value of the "
            f"run; rename the setting ({file})"
        )

    class_name = _name_of(chosen)
    checked = validated(model, settings, prefix or f"{group}.", f"setting of {class_name}", class_name)
    return Component(group, name, chosen, dict(checked), options=checked if isinstance(checked, Settings) else None)


def check_base_class(group: str, name: str, target: object) -> None:
    """Refuse a class that does not fit the group, that is abstract, or that declares itself outside its card.

    Raises:
        ConfigError: the message names what the class lacks.
    """
    base_name, card = _BASES[group]
    if (target is None and group in _CAN_BE_NONE) or isinstance(card_named(str(target)), card):
        return
    file = file_of(group, name)
    cls, base = _load_target(group, target, file), load_class(base_name)
    named_base = f"{base.__name__} ({base.__module__})"
    given = f"{group}={name}: {cls.__name__}"
    if getattr(base, "_is_protocol", False):
        methods = [method for method in vars(base) if not method.startswith("_")]
        lacks = [method for method in methods if not callable(getattr(cls, method, None))]
        if lacks:
            raise ConfigError(f"{given} is no {named_base}; it lacks {', '.join(lacks)} ({file})")
    elif not issubclass(cls, base):
        raise ConfigError(f"{given} is no {named_base}; derive it from {base.__name__} ({file})")
    left = [method for method in dir(cls) if getattr(getattr(cls, method, None), "__isabstractmethod__", False)]
    if left or cls is base:
        missing = f", which have {', '.join(left)}" if left else ""
        raise ConfigError(f"{given} is abstract; choose one of its subclasses{missing} ({file})")
    outside = cards.outside_card(cls, card)
    if outside is not None:
        raise ConfigError(f"{given}: {outside} ({file})")


@cache
def card_named(dotted: str) -> cards.Card | None:
    """Return the card of a class of this package without importing the class; None for other classes.

    The card of `package.module.Class` is `CARDS["Class"]` of the module `package.module_options` or `package.options`.
    """
    module, _, name = dotted.rpartition(".")
    package = module.rpartition(".")[0]
    if dotted.partition(".")[0] != __name__.partition(".")[0]:
        return None
    for place in (f"{module}_options", f"{package}.options"):
        try:
            known = getattr(importlib.import_module(place), "CARDS", {})
        except ModuleNotFoundError:
            continue
        if name in known:
            return known[name]
    return None


# Classes that Python code passed, by their dotted names. Those defined in a notebook or a function cannot be imported.
_passed: dict[str, type] = {}


def name_of_passed(cls: type) -> str:
    """Remember a class that Python code passes, and return the dotted name by which `load_class` finds it."""
    dotted = f"{cls.__module__}.{cls.__qualname__}"
    _passed[dotted] = cls
    return dotted


def load_class(dotted: str) -> type:
    """Import a class by its dotted name.

    Raises:
        ConfigError: there is no such class.
    """
    if dotted in _passed:
        return _passed[dotted]
    module_name, _, name = dotted.rpartition(".")
    if not module_name or not all(part.isidentifier() for part in dotted.split(".")):
        raise ConfigError(f"{dotted}: must be a class, as package.module.Class")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        # If the module exists but one of its own imports fails, the user has made no mistake.
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        raise ConfigError(f"{dotted}: there is no module {error.name}") from error
    cls = getattr(module, name, None)
    if not inspect.isclass(cls):
        raise ConfigError(f"{dotted}: there is no class {name} in {module_name}")
    return cls


def _load_target(group: str, target: object, file: str) -> type:
    try:
        return load_class(str(target))
    except ConfigError as error:
        raise ConfigError(f"{group}.{TARGET}={error} ({file})") from error


def _name_of(target: str | type | None) -> str:
    return target.rpartition(".")[2] if isinstance(target, str) else getattr(target, "__name__", "none")


def model_of(target: str | type, group: str) -> type[BaseModel]:
    """Return the model of a class's settings, given the class or its dotted name.

    Raises:
        ConfigError: there is no such class, or as for `settings_model`.
    """
    card = card_named(target) if isinstance(target, str) else None
    if card is not None:
        return card.options or create_model(_name_of(target), __config__=_STRICT)
    cls = load_class(target) if isinstance(target, str) else target
    return settings_model(cls, SUPPLIED_ARGUMENTS.get(group, ()))


def constructor_arguments(cls: type) -> dict[str, inspect.Parameter]:
    """Return the arguments of a class's constructor, without `self`."""
    constructor: Callable[..., None] = cls.__init__  # type: ignore[misc]  # a subclass's may differ, but this is `cls`
    return dict(list(inspect.signature(constructor).parameters.items())[1:])


def takes_settings_model(cls: type) -> bool:
    """Return whether the constructor takes a model of settings."""
    return hasattr(cls, "Options") and "options" in constructor_arguments(cls)


def settings_model(cls: type, supplied: Iterable[str] = ()) -> type[BaseModel]:
    """Return the model of a class's settings: its `Options`, or one made of its constructor's arguments.

    Args:
        cls: the class.
        supplied: arguments of the constructor that are no settings.

    Raises:
        ConfigError: `Options` is no settings model, or an argument has a type that yaml cannot hold.
    """
    if takes_settings_model(cls):
        model = cls.Options  # type: ignore[attr-defined]
        if not (inspect.isclass(model) and issubclass(model, Settings)):
            raise ConfigError(f"{cls.__name__}.Options: must be a subclass of {Settings.__module__}.Settings")
        return model
    hints = get_type_hints(cls.__init__, include_extras=True)  # type: ignore[misc]  # as in `constructor_arguments`
    fields: dict[str, Any] = {}
    for name, argument in constructor_arguments(cls).items():
        if name in supplied or argument.kind in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD):
            continue
        default = ... if argument.default is argument.empty else argument.default
        fields[name] = (hints.get(name, Any), default)
    try:
        return create_model(cls.__name__, __config__=_STRICT, **fields)
    except PydanticUserError as error:
        raise ConfigError(f"{cls.__name__}: has an argument that no yaml file can hold: {first_line(error)}") from error


def defaults_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the default of each setting in its yaml form; `???` if it has none."""
    defaults = model.model_construct().model_dump(mode="json", warnings=False)
    for name, field in model.model_fields.items():
        inner = field.annotation
        if inspect.isclass(inner) and issubclass(inner, BaseModel):
            defaults[name] = defaults_of(inner)
        elif field.is_required():
            defaults[name] = "???"
    return defaults


def file_of(group: str, name: str) -> str:
    """Return the path of a choice's yaml file for messages."""
    return f"conf/{group}/{name}.yaml"
