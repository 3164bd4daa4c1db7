"""Check the arguments of `gymnasium.make` and `gymnasium.make_vec`, whose own errors do not say what is allowed."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from enum import Enum
from typing import Annotated, Any

import numpy as np
from gymnasium import VectorizeMode
from gymnasium.envs.registration import _find_spec, load_env_creator  # `gymnasium.spec` imports no `module:` of an id
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from pydantic import BeforeValidator

from hpamdp.complaints import no_such
from hpamdp.settings import SettingError, Settings

_OF_VECTORS = ("autoreset_mode", "vectorization_mode", "vector_kwargs", "wrappers")
_VECTORS = {VectorizeMode.SYNC: SyncVectorEnv, VectorizeMode.ASYNC: AsyncVectorEnv}


def _check_steps(steps: Any) -> Any:
    if isinstance(steps, np.integer):
        steps = int(steps)
    if isinstance(steps, bool) or not isinstance(steps, int) or (steps < 1 and steps != -1):
        raise ValueError("must be a whole number of at least 1, or -1 for no limit")
    return steps


def _check_wrappers(wrappers: Any) -> Any:
    if not isinstance(wrappers, list | tuple) or not all(map(callable, wrappers)):
        raise ValueError("must be a list of functions or classes that wrap an environment")
    return wrappers


def _member_of(names: type[Enum]) -> BeforeValidator:
    """Return a check for a member of an enumeration or its value; it returns the member."""

    def check(given: Any) -> Any:
        try:
            return names(given)
        except ValueError:
            raise ValueError(f"must be one of {', '.join(member.value for member in names)}") from None

    return BeforeValidator(check)


class _Arguments(Settings):
    """Arguments of `gymnasium.make` and `gymnasium.make_vec`."""

    max_episode_steps: Annotated[Any, BeforeValidator(_check_steps)] = None
    disable_env_checker: bool | None = None
    render_mode: str | None = None
    autoreset_mode: Annotated[Any, _member_of(AutoresetMode)] = None
    vectorization_mode: Annotated[Any, _member_of(VectorizeMode)] = None
    vector_kwargs: dict[str, Any] | None = None
    wrappers: Annotated[Any, BeforeValidator(_check_wrappers)] = None


def checked_arguments(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments with those of Gymnasium checked; None stands for the default of each, and stays.

    Raises:
        SettingError: one has a wrong value.
    """
    own = {name: given[name] for name in _Arguments.model_fields if given.get(name) is not None}
    checked = _Arguments.of(None, own)
    return {**given, **{name: getattr(checked, name) for name in own}}


def names_of_arguments(env_id: str) -> list[str]:
    """Return the names of the arguments that the constructor behind an id takes."""
    creator: Any = _find_spec(env_id).entry_point
    if isinstance(creator, str):
        creator = load_env_creator(creator)
    parameters = [] if creator is None else inspect.signature(creator).parameters.values()
    return [each.name for each in parameters if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)]


def check_single(env_id: str, given: Mapping[str, Any]) -> None:
    """Refuse, for one environment, what only a vector takes.

    Raises:
        SettingError: there is such an argument.
    """
    for name in _OF_VECTORS:
        if name in given and name not in names_of_arguments(env_id):
            raise SettingError(f"{name}: only a vector takes it; give num_envs, too")


def vector_arguments(env_id: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return checked arguments of `gymnasium.make_vec` as it takes them.

    A vector of a problem of this package restarts in the same step, unless `autoreset_mode` says otherwise.

    Args:
        env_id: the id of the environment.
        given: what `checked_arguments` returned.

    Raises:
        SettingError: an argument does not go with the kind of the vector.
    """
    if given.get("autoreset_mode") is None:
        given = {name: value for name, value in given.items() if name != "autoreset_mode"}
    default = VectorizeMode.SYNC
    if _find_spec(env_id).vector_entry_point is not None:
        default = VectorizeMode.VECTOR_ENTRY_POINT
    mode = given.get("vectorization_mode") or default
    restarts = {"autoreset_mode": AutoresetMode.SAME_STEP} if env_id.startswith("hpamdp/") else {}
    of_vector = given.get("vector_kwargs") or {}
    if mode == VectorizeMode.VECTOR_ENTRY_POINT:
        for name in ("vector_kwargs", "wrappers"):
            if given.get(name):
                raise SettingError(f"{name}: the problem's own vector takes none; use vectorization_mode='sync'")
        return {**restarts, **given}
    names = [name for name in inspect.signature(_VECTORS[mode]).parameters if name != "env_fns"]
    for name in of_vector:
        if name not in names:
            raise SettingError(f"vector_kwargs: {name}: {no_such('argument', name, names)}")
    if "autoreset_mode" in given:
        of_vector = {**of_vector, "autoreset_mode": given["autoreset_mode"]}
    of_vector = checked_arguments(of_vector)
    others = {name: value for name, value in given.items() if name != "autoreset_mode"}
    return {**others, "vector_kwargs": {**restarts, **of_vector}}
