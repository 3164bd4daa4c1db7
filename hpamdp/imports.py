"""Imports that take seconds."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

# Imports make hundreds of thousands of objects, the parts of a run some ten thousand.
_MANY = 50_000


@contextmanager
def collector_paused() -> Iterator[None]:
    """Pause the garbage collector while the block, or the decorated function, imports and builds the parts of a run.

    It would search hundreds of thousands of new objects again and again, a quarter of the block's CPU time, although
    imports leave hardly any garbage.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        # The collector searches a few new objects anyway. Objects that somebody has frozen would be freed, too, and to
        # count them takes a tenth of a second in a process that has frozen its imports.
        if gc.get_count()[0] > _MANY and gc.get_freeze_count() == 0:
            gc.freeze()
            gc.unfreeze()  # moves all objects to the oldest generation, so that short collections leave them out
        if was_enabled:
            gc.enable()
