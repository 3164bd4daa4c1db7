"""Turn the arguments of Python functions into choices of yaml files, settings and objects."""

from __future__ import annotations

import copy
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import torch
from gymnasium.vector import VectorEnv

from hpamdp.complaints import no_such
from hpamdp.config.components import GROUPS, takes_settings_model
from hpamdp.config.compose import choosing, conf_dir
from hpamdp.config.errors import ConfigError
from hpamdp.config.outside_jobs import choosing_class, given_twice
from hpamdp.env.base import PAMDPEnv
from hpamdp.messages import as_code, first_line

_ACCEPTED = (
    "a name such as 'platform', a Gymnasium id, a function or class that returns an environment of Gymnasium or "
    "TorchRL, such an environment, or a PAMDPEnv or its class"
)


@dataclass(frozen=True)
class Problem:
    """The argument of a Python function that chooses a problem.

    Attributes:
        words: the word of the command line that chooses it, if it is chosen.
        settings: its settings by their names on the command line.
        objects: arguments for its constructor, which no file can hold.
        copied: the settings of a built problem. Unlike `settings`, they may be given once more with other values.
        num_envs: number of environments of a built problem; else None.
    """

    words: list[str] = field(default_factory=list)
    settings: list[tuple[str, Any]] = field(default_factory=list)
    objects: Mapping[str, Any] = field(default_factory=dict)
    copied: Mapping[str, Any] = field(default_factory=dict)
    num_envs: int | None = None

    def with_settings(self, others: Iterable[tuple[str, Any]] = ()) -> list[tuple[str, Any]]:
        """Return the settings of the problem, and after them those of the function's other arguments."""
        given = [*self.settings, *others]
        names = {name if name.startswith("env.") else f"env.{name}" for name, _ in given}
        return [*((name, value) for name, value in self.copied.items() if name not in names), *given]


def path_argument(name: str, value: Any) -> Path:
    """Return a path that Python code gives, with the home directory in place of `~`.

    Raises:
        ConfigError: the value is no path.
    """
    if not isinstance(value, str | Path) or not str(value):
        raise ConfigError(f"{name}={as_code(value)}: must be a path")
    path = Path(os.path.expanduser(value))  # before `Path` drops "./", after which "./~" would mean the home directory
    return path.absolute() if str(path).startswith("~") else path  # so that nobody expands it later


def flag(name: str, value: Any) -> None:
    """Refuse an argument that is neither True nor False.

    Raises:
        ConfigError: it is something else.
    """
    if value is not True and value is not False:
        raise ConfigError(f"{name}={as_code(value)}: must be True or False")


def count(name: str, value: Any) -> None:
    """Refuse an argument that is no whole number of at least 1.

    Raises:
        ConfigError: it is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ConfigError(f"{name}={as_code(value)}: must be a whole number of at least 1")


def choices_and_settings(given: Mapping[str, Any]) -> tuple[list[str], list[tuple[str, Any]]]:
    """Return the words for the choices among arguments such as `low="hppo"` and `seed=1`, and the other arguments.

    The value of a group, such as `low`, is the name of a yaml file, a class, None, or a mapping of `name` and settings.

    Raises:
        ConfigError: a value has no such form, or the setting is Hydra's.
    """
    words: list[str] = []
    settings: list[tuple[str, Any]] = []
    for name, value in given.items():
        if name.partition(".")[0] == "hydra":
            raise ConfigError(f"{name}: Hydra runs no job here; give folder or config_dirs instead")
        if name in GROUPS:
            chosen, own = _choice(name, value)
            words, settings = [*words, *chosen], [*settings, *own]
        elif (conf_dir() / name).is_dir():
            words.append(f"{name}=null" if value is None else choosing(name, str(value)))
        else:
            settings.append((name, str(value) if isinstance(value, torch.device) else value))
    return words, settings


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


def _choice(group: str, value: Any) -> tuple[list[str], list[tuple[str, Any]]]:
    """Return the word that chooses a yaml file or a class for a group, if one is chosen, and the group's settings."""
    if isinstance(value, Mapping):
        for name, each in value.items():
            if name == group or (name != "name" and isinstance(each, type)):
                raise ConfigError(f"{group}: {as_code(each)} is given as {name!r}; write {{'name': ..., ...}}")
        chosen = _choice(group, value["name"])[0] if "name" in value else []
        return chosen, [(f"{group}.{name}", each) for name, each in value.items() if name != "name"]
    if isinstance(value, type):
        return [choosing(group, choosing_class(group, value))], []
    if value is not None and not isinstance(value, str):
        raise ConfigError(f"{group}={as_code(value)}: must be a name, a class, None, or a dict of name and settings")
    return [choosing(group, "none" if value is None else value)], []


def problem_of(env: Any) -> Problem:
    """Return what the argument that chooses a problem says.

    Args:
        env: see `hpamdp.train`.

    Raises:
        ConfigError: it is nothing of the accepted kind.
    """
    if env is None:
        return Problem()
    if isinstance(env, str):
        return _named(env)
    if isinstance(env, Mapping) and "name" in env:
        chosen, own = problem_of(env["name"]), _choice("env", {**env, "name": "none"})[1]
        return replace(chosen, settings=[*chosen.settings, *own])
    if isinstance(env, Mapping) or _is_problem_class(env):
        return Problem(*_choice("env", env))
    if isinstance(env, PAMDPEnv):
        return _like_built(env)
    return _of_gymnasium(env)


def _of_gymnasium(env: Any) -> Problem:
    if not isinstance(env, VectorEnv):
        if hasattr(env, "step") and not isinstance(env, type):  # of another kind is refused where it is copied
            return Problem(["env=gymnasium"], objects={"make": _copier(env)})
        if callable(env):
            return _of_callable(env)
    raise ConfigError(f"env={as_code(env)}: must be {_ACCEPTED}")


def _is_problem_class(env: Any) -> bool:
    return isinstance(env, type) and issubclass(env, PAMDPEnv)


def _named(name: str) -> Problem:
    own = plain_name(name)
    if name.startswith("hpamdp/"):
        if re.search(r"-v\d+$", name) and name.lower() not in {each.lower() for each in gymnasium.registry}:
            ids = [each for each in gymnasium.registry if each.startswith("hpamdp/")]
            raise ConfigError(f"{name}: {no_such('problem with a Gymnasium id', name, ids)}")
        names = [file.stem for file in (conf_dir() / "env").glob("*.yaml") if plain_name(file.stem) == own]
        if names:
            return Problem([choosing("env", names[0])])
    is_id = name in gymnasium.registry or re.search(r"-v\d+$", name)
    if is_id or ":" in name:
        return Problem(["env=gymnasium"], [("env.id" if is_id else "env.entry_point", name)])
    return Problem([choosing("env", name)])


def plain_name(name: str) -> str:
    """Return a name without case, underscores, namespace and version: `hard_goal` is `hpamdp/HardGoal-v0`."""
    return name.removeprefix("hpamdp/").partition("-v")[0].replace("_", "").lower()


def _like_built(env: PAMDPEnv) -> Problem:
    """Return a problem like a built one, with its options."""
    cls = type(env)
    if not takes_settings_model(cls):
        raise ConfigError(f"env={as_code(env)}: its settings are unknown; pass the class {cls.__name__}")
    settings = {f"env.{name}": value for name, value in env.options.model_dump(mode="json").items()}
    grouping = {} if env.grouping is None else {"env.grouping": env.grouping}
    return Problem(_choice("env", cls)[0], copied={**settings, **grouping}, num_envs=env.num_envs)


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


def _of_callable(make: Callable[[], Any]) -> Problem:
    """Return the problem of a class or a function: by its name if it can be imported, otherwise by itself."""
    module, name = getattr(make, "__module__", None), getattr(make, "__qualname__", "")
    if (
        module not in (None, "__main__")
        and name.isidentifier()
        and getattr(sys.modules.get(module), name, None) is make
    ):
        return Problem(["env=gymnasium"], [("env.entry_point", f"{module}:{name}")])
    return Problem(["env=gymnasium"], objects={"make": make})
