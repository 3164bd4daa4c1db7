"""Where batches come from: the environments of a run, stepped in this process or in others."""

from __future__ import annotations

from typing import ClassVar

from tensordict import TensorDictBase
from torch import Tensor


class Collection:
    """Gives batches of the agent acting in the run's environments, until it is closed.

    A subclass's `__init__` takes any of `config`, `parts` and `frames` (steps so far) and its options as keyword
    arguments, which are the schema of its yaml. Every collection gives batches of the same keys and shape, with the
    environments in the same order, from the current policy.
    """

    package: ClassVar[str | None] = None  # an optional package that it needs; also the name of the extra
    has_workers: ClassVar[bool] = False  # whether other processes step the environments
    cpu_s: float = 0.0  # spent collecting in other processes

    def next(self) -> TensorDictBase:
        """Collect a batch `[num_envs, steps_per_batch]`."""
        raise NotImplementedError

    def env_state(self) -> dict[str, Tensor]:
        """Return where the environments stand, as their own `state_columns` do."""
        raise NotImplementedError

    def close(self) -> None:
        """End all other processes."""
