"""Make the package's environments, for TorchRL and for Gymnasium."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import gymnasium
from gymnasium import VectorizeMode
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from pydantic import NonNegativeInt

from hpamdp.api.arguments import plain_name, problem_of, without_env_prefix
from hpamdp.complaints import close_names, no_such
from hpamdp.config.components import SUPPLIED_ARGUMENTS
from hpamdp.config.compose import job_overrides, read
from hpamdp.config.errors import ConfigError, validated
from hpamdp.config.outside_jobs import composed
from hpamdp.config.schema import Device, usable_device
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.registration import register
from hpamdp.messages import as_code, first_line, warn
from hpamdp.run.assemble import grouped
from hpamdp.run.compatibility import lack_of, settings_without_effect
from hpamdp.settings import NumAtOnce, Settings

# Values of `vectorization_mode` for a problem's own vector, if it has one.
_OWN_VECTOR = (None, "vector_entry_point", VectorizeMode.VECTOR_ENTRY_POINT)


class _Sizes(Settings):
    """The arguments of `make` that are no settings of the problem."""

    num_envs: NumAtOnce = 1
    seed: NonNegativeInt = 0
    oracle: bool = False
    human: bool = False
    device: Device = "cpu"


def make(name: Any, num_envs: int | None = None, *, device: Any = "cpu", seed: int = 0, **settings: Any) -> PAMDPEnv:
    """Make a problem as a batched TorchRL environment.

    Args:
        name: a choice of `env` on the command line, such as `platform`, a Gymnasium id, or what else `train` takes.
        num_envs: number of environments in the batch. If None, that of a built environment, else 1.
        device: of the tensors.
        seed: of the episodes.
        settings: the problem's settings, such as `max_steps=50` or, as for `train`, `**{"env.max_steps": 50}`.
            `oracle=True` and `human=True` add entries for players that need them.

    Raises:
        ConfigError: there is no such problem, or a setting is wrong or given twice.

    Example:
        >>> import hpamdp
        >>> env = hpamdp.make("platform", num_envs=4)
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([4, 3, 1])
    """
    supplied = {each: settings.pop(each) for each in SUPPLIED_ARGUMENTS["env"] if each in settings}
    problem = problem_of(name)
    if num_envs is None:
        num_envs = problem.num_envs or 1
    sizes = validated(_Sizes, {"num_envs": num_envs, "seed": seed, **supplied}, "", "argument", "hpamdp.make")
    own = [(f"env.{each}", value) for each, value in without_env_prefix(settings).items()]
    with composed(problem.words, problem.with_settings([*own, ("device", str(device))])) as cfg:
        config = read(cfg).with_objects(problem.objects)
        for line in settings_without_effect(config, job_overrides()):
            warn(line)
    needs = {each: True for each in ("oracle", "human") if getattr(sizes, each)}
    for need in needs:
        lack = lack_of(need, config)
        if lack is not None:
            raise ConfigError(f"{need}=True: {lack}")
    env = config.env.build(num_envs=sizes.num_envs, device=config.run.resolve_device(), seed=sizes.seed, **needs)
    return grouped(env, config)


def make_gymnasium(name: str, num_envs: int | None = None, **settings: Any) -> Any:
    """Make a problem as a Gymnasium environment, or as a vector of them.

    Args:
        name: a problem of this package with a Gymnasium id, such as `platform`, or any id.
        num_envs: number of environments in a vector. If None, a single environment.
        settings: as for `gymnasium.make` or `gymnasium.make_vec`, such as `render_mode="rgb_array"`, and the problem's
            own, such as `max_steps=50`.

    Returns:
        A `gymnasium.Env`, or a `gymnasium.vector.VectorEnv` if `num_envs` is given. A vector of a problem of this
        package restarts finished episodes in the same step, as `Agent.reset` expects; `autoreset_mode="NextStep"` is
        Gymnasium's default.

    Raises:
        ConfigError: there is no such id or device, a package is missing, or a setting is wrong or given twice.

    Example:
        >>> import hpamdp
        >>> env = hpamdp.make_gymnasium("platform")
        >>> env.reset(seed=0)[0].shape
        (9,)
    """
    env_id = _id_of(name)
    own = without_env_prefix(settings)
    sizes: dict[str, Any] = {} if num_envs is None else {"num_envs": num_envs}
    if "device" in own and env_id.startswith("hpamdp/"):
        sizes["device"] = str(own["device"])
    checked = validated(_Sizes, sizes, "", "argument", "hpamdp.make_gymnasium")
    if "device" in sizes:
        own["device"] = usable_device(checked.device)
    try:
        if num_envs is None:
            return gymnasium.make(env_id, **own)
        return gymnasium.make_vec(env_id, num_envs=checked.num_envs, **_vector_arguments(env_id, own))
    except (gymnasium.error.Error, AssertionError, ImportError, RuntimeError, TypeError, ValueError) as error:
        raise ConfigError(f"{env_id}: {first_line(error)}") from error


def _vector_arguments(env_id: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments for `gymnasium.make_vec`, which takes `autoreset_mode` elsewhere in each kind of vector.

    A vector of a problem of this package restarts in the same step, unless `autoreset_mode` says otherwise.
    """
    others = {name: value for name, value in given.items() if name != "autoreset_mode"}
    restarts = given.get("autoreset_mode") or (AutoresetMode.SAME_STEP if env_id.startswith("hpamdp/") else None)
    if restarts is None:
        return others
    has_own = _spec_of(env_id).vector_entry_point is not None
    if has_own and others.get("vectorization_mode") in _OWN_VECTOR:
        return {**others, "autoreset_mode": restarts}
    return {**others, "vector_kwargs": {"autoreset_mode": restarts, **(others.get("vector_kwargs") or {})}}


def _spec_of(env_id: str) -> EnvSpec:
    module, _, name = env_id.rpartition(":")
    if module:
        importlib.import_module(module)  # as `gymnasium.make` does
    return gymnasium.spec(name)


def _id_of(name: str) -> str:
    register()
    if not isinstance(name, str):
        raise ConfigError(f"make_gymnasium: {as_code(name)} must be the name of a problem, or a Gymnasium id")
    if name in gymnasium.registry or "-v" in name or ":" in name:
        return name
    ids = {plain_name(each): each for each in gymnasium.registry if each.startswith("hpamdp/")}
    if plain_name(name) not in ids:
        guesses = [ids[each] for each in close_names(plain_name(name), [*ids])]
        raise ConfigError(f"{name}: {no_such('problem with a Gymnasium id', name, ids.values(), guesses=guesses)}")
    return ids[plain_name(name)]
