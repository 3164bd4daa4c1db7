"""Registration of the problems' Gymnasium ids."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from typing import Any

import gymnasium

import hpamdp.env

# Settings of `GymnasiumEnv` that name the environment, and all that say which environment it is.
NAMING_SETTINGS = ("id", "entry_point")
SOURCE_SETTINGS = (*NAMING_SETTINGS, "kwargs")


def register() -> None:
    """Register the Gymnasium ids of all problems; calling it again changes nothing.

    A problem with a Gymnasium interface has a module `registration` in its folder, with a function `register()`. Since
    every import of the package calls it, it must import neither torch nor TorchRL: Gymnasium takes the environment's
    class as text, `package.module:Class`, and imports it when it is made.
    """
    for problem in pkgutil.iter_modules(hpamdp.env.__path__, "hpamdp.env."):
        name = f"{problem.name}.registration"
        if problem.ispkg and importlib.util.find_spec(name) is not None:
            importlib.import_module(name).register()


def register_batched_env(env_id: str, problem: str, **settings: Any) -> None:
    """Register an id of a `BatchedEnv`, single and vectorised; calling it again changes nothing.

    Args:
        env_id: such as `hpamdp/Platform-v0`.
        problem: the environment's class as text, `package.module:Class`.
        settings: arguments of the constructor that this id fixes.
    """
    if env_id in gymnasium.registry:
        return
    # No max_episode_steps: the environment itself truncates after its last step.
    gymnasium.register(
        id=env_id,
        entry_point="hpamdp.env.batched_adapter:BatchedEnvAdapter",
        vector_entry_point="hpamdp.env.batched_adapter:BatchedEnvVectorAdapter",
        kwargs={"problem": problem, **settings},
    )
