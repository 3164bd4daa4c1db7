"""Whether policies explore or act greedily: TorchRL's exploration type, one thread at a time."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type

_turn = threading.RLock()


@contextmanager
def acting(exploration: ExplorationType) -> Iterator[None]:
    """Have policies explore or act greedily inside the block. Blocks of other threads wait until it ends.

    TorchRL has one exploration type for all threads. Without the lock, an evaluation in one thread would make another
    thread collect greedy steps. Two blocks that overlap could leave the type of one of them behind.
    """
    with _turn, set_exploration_type(exploration):
        yield


def is_greedy() -> bool:
    """Return whether policies must act greedily; otherwise they explore."""
    return exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE)
