"""Imports that take seconds."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager


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
        if gc.get_freeze_count() == 0:  # else objects that somebody has frozen would be freed, too
            gc.freeze()
            gc.unfreeze()  # moves all objects to the oldest generation, so that short collections leave them out
        if was_enabled:
            gc.enable()
