"""Turn the arguments of Python functions into the words of a command line, and objects that no word can hold."""

from __future__ import annotations

import copy
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import torch
from gymnasium.vector import VectorEnv
from torchrl.envs import EnvBase

from hpamdp.complaints import no_such
from hpamdp.config.components import GROUPS, takes_settings_model
from hpamdp.config.compose import conf_dir, setting_of
from hpamdp.config.errors import ConfigError
from hpamdp.config.outside_jobs import check_given_once, choosing_class, given_twice, word
from hpamdp.config.schema import RunConfig
from hpamdp.env.base import PAMDPEnv
from hpamdp.messages import as_code, first_line

_ACCEPTED = (
    "a name such as 'platform', a Gymnasium id, a function or class that returns a Gymnasium environment, such an "
    "environment, or a PAMDPEnv or its class"
)


@dataclass(frozen=True)
class Arguments:
    """The argument of a Python function that chooses a problem.

    Attributes:
        words: the words of the command line that says the same.
        objects: arguments for the constructor of the problem, which no word can hold.
        copied: words for the class and the settings of a built problem. Unlike `words`, they may be given once more
            with other values.
        num_envs: number of environments of a built problem; else None.
    """

    words: list[str] = field(default_factory=list)
    objects: Mapping[str, Any] = field(default_factory=dict)
    copied: list[str] = field(default_factory=list)
    num_envs: int | None = None

    def with_words(self, others: Sequence[str] = ()) -> list[str]:
        """Return the words of the problem, and after them those of the function's other arguments.

        Raises:
            ConfigError: a setting is given twice. On a command line the last one would count in silence.
        """
        given = [*self.words, *others]
        check_given_once(given)
        replaced = {setting_of(each) for each in given}  # Hydra would merge two mappings
        return [*(each for each in self.copied if setting_of(each) not in replaced), *given]


def path_argument(name: str, value: Any) -> Path:
    """Return a path that Python code gives, with the home directory in place of `~`.

    Raises:
        ConfigError: the value is no path.
    """
    if not isinstance(value, str | Path) or not str(value) or "\0" in str(value):
        raise ConfigError(f"{name}={as_code(value)}: must be a path")
    try:
        os.fsencode(value)
    except UnicodeEncodeError as error:
        raise ConfigError(f"{name}={as_code(value)}: must be a path; no file can have this name") from error
    path = Path(os.path.expanduser(value))  # before `Path` drops "./", after which "./~" would mean the home directory
    return path.absolute() if str(path).startswith("~") else path  # so that nobody expands it later


def flag(name: str, value: Any) -> None:
    """Refuse an argument that is neither True nor False.

    Raises:
        ConfigError: it is something else.
    """
    if value is not True and value is not False:
        raise ConfigError(f"{name}={as_code(value)}: must be True or False")


def all_but(settings: Mapping[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Return the settings whose names are not among these."""
    return {name: value for name, value in settings.items() if name not in names}


def settings_words(settings: Mapping[str, Any]) -> list[str]:
    """Return the words for settings by their names on the command line, such as `seed` and `low.lr`.

    The value of a group, such as `low`, is the name of a yaml file, a class, None, or a mapping of `name` and settings.

    Raises:
        ConfigError: a value has no such form, or the setting is Hydra's.
    """
    words: list[str] = []
    for name, value in settings.items():
        if name.partition(".")[0] == "hydra":
            raise ConfigError(f"{name}: Hydra runs no job here; give folder or config_dirs instead")
        value = str(value) if isinstance(value, torch.device) else value
        words += _group_words(name, value) if name in GROUPS else [word(name, value)]
    return words


def unprefixed(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings without a dot that are neither a value of the run nor a group, such as `max_steps`."""
    names = {*RunConfig.model_fields, *GROUPS, *(folder.name for folder in conf_dir().iterdir())}
    return {name: value for name, value in settings.items() if "." not in name and name not in names}


def with_env_prefix(settings: Mapping[str, Any], of_problem: Iterable[str]) -> dict[str, Any]:
    """Return settings with `env.` before the names that the problem has; other names stay, for `composed` to refuse.

    Args:
        settings: what `unprefixed` returned.
        of_problem: names of the problem's settings.
    """
    known = set(of_problem)
    return {f"env.{name}" if name in known else name: value for name, value in settings.items()}


def without_env_prefix(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of the problem without the `env.` that `train` writes before them.

    Raises:
        ConfigError: a setting is given twice.
    """
    plain: dict[str, Any] = {}
    for name, value in settings.items():
        own = name.removeprefix("env.")
        if own in plain:
            raise ConfigError(given_twice(own, plain[own], value))
        plain[own] = value
    return plain


def _group_words(group: str, value: Any) -> list[str]:
    if isinstance(value, type):
        return [choosing_class(group, value)]
    if isinstance(value, Mapping):
        chosen = _group_words(group, value["name"]) if "name" in value else []
        own = {name: each for name, each in value.items() if name != "name"}
        return [*chosen, *(word(f"{group}.{name}", each) for name, each in own.items())]
    if value is None:
        return [f"{group}=none"]
    if not isinstance(value, str):
        raise ConfigError(f"{group}={as_code(value)}: must be a name, a class, None, or a dict of name and settings")
    return [word(group, value)]


def problem_arguments(env: Any) -> Arguments:
    """Return the arguments that choose a problem.

    Args:
        env: see `hpamdp.train`.

    Raises:
        ConfigError: it is nothing of the accepted kind.
    """
    if env is None:
        return Arguments()
    if isinstance(env, str):
        return Arguments(_words_of_name(env))
    if isinstance(env, Mapping) and "name" in env:
        chosen = problem_arguments(env["name"])
        own = [word(f"env.{name}", value) for name, value in env.items() if name != "name"]
        return replace(chosen, words=[*chosen.words, *own])
    if isinstance(env, Mapping) or _is_problem_class(env):
        return Arguments(_group_words("env", env))
    if isinstance(env, PAMDPEnv):
        return Arguments(copied=_words_of_built(env), num_envs=env.num_envs)
    return _arguments_of_gymnasium(env)


def _arguments_of_gymnasium(env: Any) -> Arguments:
    if isinstance(env, gymnasium.Env):
        return Arguments(["env=gymnasium"], {"make": _copier(env)})
    if callable(env) and not isinstance(env, EnvBase | VectorEnv):
        return _arguments_of_callable(env)
    raise ConfigError(f"env={as_code(env)}: must be {_ACCEPTED}")


def _is_problem_class(env: Any) -> bool:
    return isinstance(env, type) and issubclass(env, PAMDPEnv)


def _words_of_name(name: str) -> list[str]:
    own = plain_name(name)
    if name.startswith("hpamdp/"):
        if re.search(r"-v\d+$", name) and name.lower() not in {each.lower() for each in gymnasium.registry}:
            ids = [each for each in gymnasium.registry if each.startswith("hpamdp/")]
            raise ConfigError(f"{name}: {no_such('problem with a Gymnasium id', name, ids)}")
        names = [file.stem for file in (conf_dir() / "env").glob("*.yaml") if plain_name(file.stem) == own]
        if names:
            return [word("env", names[0])]
    is_id = name in gymnasium.registry or re.search(r"-v\d+$", name)
    if is_id:
        return ["env=gymnasium", word("env.id", name)]
    if ":" in name:
        return ["env=gymnasium", word("env.entry_point", name)]
    return [word("env", name)]


def plain_name(name: str) -> str:
    """Return a name without case, underscores, namespace and version: `hard_goal` is `hpamdp/HardGoal-v0`."""
    return name.removeprefix("hpamdp/").partition("-v")[0].replace("_", "").lower()


def _words_of_built(env: PAMDPEnv) -> list[str]:
    """Return the words for a problem like a built one, with its options."""
    cls = type(env)
    if not takes_settings_model(cls):
        raise ConfigError(f"env={as_code(env)}: its settings are unknown; pass the class {cls.__name__}")
    settings = [word(f"env.{name}", value) for name, value in env.options.model_dump(mode="json").items()]
    grouping = [] if env.grouping is None else [word("env.grouping", env.grouping)]
    return [choosing_class("env", cls), *settings, *grouping]


def _copier(env: gymnasium.Env) -> Callable[[], gymnasium.Env]:
    """Return a function that copies an environment, which itself stays as it is.

    Raises:
        ConfigError: the environment cannot be copied.
    """
    try:
        first = copy.deepcopy(env)
    except Exception as error:
        why = f"{type(error).__name__}: {first_line(error)}"
        raise ConfigError(f"env={as_code(env)}: cannot be copied ({why}); pass a function that makes it") from error
    return partial(copy.deepcopy, first)


def _arguments_of_callable(make: Callable[[], Any]) -> Arguments:
    """Return the arguments for a class or a function: its name if it can be imported, otherwise itself."""
    module, name = getattr(make, "__module__", None), getattr(make, "__qualname__", "")
    if (
        module not in (None, "__main__")
        and name.isidentifier()
        and getattr(sys.modules.get(module), name, None) is make
    ):
        return Arguments(["env=gymnasium", word("env.entry_point", f"{module}:{name}")])
    return Arguments(["env=gymnasium"], {"make": make})
