"""Registration of the problems' Gymnasium ids."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
from typing import Any

import gymnasium

import hpamdp.env


def register() -> None:
    """Register the Gymnasium ids of all problems; calling it again changes nothing.

    A problem with a Gymnasium interface has a module `registration` in its folder, with `IDS`: the arguments of
    `gymnasium.register` for each id. Since every import of the package loads it, it must import neither torch nor
    TorchRL: Gymnasium takes the environment's class as text, `package.module:Class`, and imports it when it is made.
    """
    for problem in pkgutil.iter_modules(hpamdp.env.__path__, "hpamdp.env."):
        name = f"{problem.name}.registration"
        if problem.ispkg and importlib.util.find_spec(name) is not None:
            for env_id, arguments in importlib.import_module(name).IDS.items():
                if env_id not in gymnasium.registry:
                    gymnasium.register(env_id, **arguments)


def batched(problem: str, **settings: Any) -> dict[str, Any]:
    """Return the arguments of `gymnasium.register` for a `BatchedEnv`, single and vectorised.

    Args:
        problem: the environment's class as text, `package.module:Class`.
        settings: arguments of the constructor that the id fixes.
    """
    # No max_episode_steps: the environment itself truncates after its last step.
    return {
        "entry_point": "hpamdp.env.batched_adapter:BatchedEnvAdapter",
        "vector_entry_point": "hpamdp.env.batched_adapter:BatchedEnvVectorAdapter",
        "kwargs": {"problem": problem, **settings},
    }
