"""Define collections, which step a run's environments in this process or in others, and return batches."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

import numpy as np
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from hpamdp.cards import CollectorCard
from hpamdp.run.checkpoint import check_like


def check_state(state: Mapping[str, Any], env: TransformedEnv) -> None:
    """Check that the `env` of a collection's state is one of these environments.

    Raises:
        ValueError: the state is of other environments, or holds numbers that they do not take.
    """
    columns = state["env"]
    if not columns:
        return
    if env.keeps_episodes:
        num_envs = env.batch_size.numel()
        sizes = {len(column) if column.ndim else 0 for column in columns.values()} - {num_envs}
        if sizes:
            raise ValueError(
                f"num_envs={num_envs}: the state is of {sizes.pop()} environments; leave num_envs out when you resume"
            )
    check_like("env", columns, env.env_state())
    env.check_env_state(columns)


def random_seeds(seed: int, first_env: int, frames: int, restart: int = 0) -> tuple[int, int]:
    """Return the seeds of exploration and of new episodes of a process that begins or continues a run.

    Args:
        seed: of the run.
        first_env: number of the process's first environment.
        frames: steps so far.
        restart: 0 for a first process; the number of the restart for a replacement.
    """
    source = (seed, first_env, frames, restart) if restart else (seed, first_env, frames)
    exploration, episodes = map(int, np.random.SeedSequence(source).generate_state(2))
    return exploration, episodes


class CollectionError(Exception):
    """Raised if other processes cannot start or continue; the message is one line."""


class WorkerDiedError(CollectionError):
    """Raised if a worker process ends before the run does."""


class Collection:
    """Let the agent act in the run's environments and return batches, until the collection is closed.

    A subclass's `__init__` takes any of `config`, `parts` and `frames` (steps so far), which the program supplies, and
    its settings as `options`. Batches of all collections have the same keys, shape and order of environments. A
    collection uses the current policy, or the policy of the previous batch if it collects ahead.

    Attributes:
        while_replacing: makes a context for the wait for another process in place of a dead one. The run sets it.
    """

    card: ClassVar[CollectorCard] = CollectorCard()
    cpu_s: float = 0.0  # spent collecting in other processes
    while_replacing: Callable[[], AbstractContextManager] = nullcontext

    @abstractmethod
    def next(self) -> TensorDictBase:
        """Collect a batch `[num_envs, steps_per_batch]`.

        Raises:
            CollectionError: another process died, or this machine reached a limit.
        """
        raise NotImplementedError

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Return the state of the collection for a checkpoint.

        `env` is the environments' `env_state`, with first dimension `num_envs`. If that holds the current episodes,
        `root` is the tensordict `[num_envs]` from which the next step is made, as a nested dictionary.
        """
        raise NotImplementedError

    @abstractmethod
    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`.

        Raises:
            ValueError: the state is of another run, for example with another number of environments.
        """
        raise NotImplementedError

    def close(self) -> None:
        """End all other processes."""
