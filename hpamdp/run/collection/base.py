"""Where batches come from: the environments of a run, stepped in this process or in others."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

from tensordict import TensorDictBase


class CollectionError(Exception):
    """Other processes cannot start or go on; told in one line."""


class WorkerDiedError(CollectionError):
    """A worker process that ended before the run did."""


class Collection:
    """Gives batches of the agent acting in the run's environments, until it is closed.

    A subclass's `__init__` takes any of `config`, `parts` and `frames` (steps so far) and its options as keyword
    arguments, which are the schema of its yaml. Every collection gives batches of the same keys and shape, with the
    environments in the same order, from the current policy, or from that of the batch before if it collects ahead.
    """

    package: ClassVar[str | None] = None  # an optional package that it needs; also the name of the extra
    guarded_settings: ClassVar[tuple[str, ...]] = ()  # which can run code, read files or reach servers
    has_workers: ClassVar[bool] = False  # whether other processes step the environments
    cpu_s: float = 0.0  # spent collecting in other processes

    @abstractmethod
    def next(self) -> TensorDictBase:
        """Collect a batch `[num_envs, steps_per_batch]`.

        Raises:
            CollectionError: another process died, or this machine does not let it go on.
        """
        raise NotImplementedError

    def notices(self) -> list[str]:
        """Return the lines for the user since the last call, such as of a worker that was replaced."""
        return []

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Return the state of the collection for a checkpoint.

        `env`: the environments' `env_state`, first dimension `num_envs`. Where it holds their episodes, also `root`,
        the tensordict `[num_envs]` from which the next step is made, as a nested dictionary.
        """
        raise NotImplementedError

    @abstractmethod
    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`.

        Raises:
            ValueError: it is of another number of environments.
        """
        raise NotImplementedError

    def close(self) -> None:
        """End all other processes."""
