"""Where batches come from: the environments of a run, stepped in this process or in others."""

from __future__ import annotations

from typing import ClassVar

from tensordict import TensorDictBase
from torch import Tensor


class Collection:
    """Gives batches of the agent acting in the run's environments, until it is closed.

    A subclass's `__init__` takes any of `cfg`, `settings`, `parts` and `frames` (presses so far) and its options as
    keyword arguments, which are the schema of its yaml. Whatever collects, a batch has the same keys and shape, the
    environments in the same order, and comes from the policy as it is now.
    """

    package: ClassVar[str | None] = None  # that it needs beyond the project's own; also the name of the extra
    cpu_s: float = 0.0  # spent collecting in other processes

    def next(self) -> TensorDictBase:
        """Collect a batch `[num_envs, steps_per_batch]`."""
        raise NotImplementedError

    def env_state(self) -> dict[str, Tensor]:
        """Return where the environments stand, as their own `state_columns` do."""
        raise NotImplementedError

    def close(self) -> None:
        """End all other processes, whatever state they are in."""
