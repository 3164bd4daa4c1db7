"""Name the limit of this machine that keeps other processes from starting or from sharing memory."""

from __future__ import annotations

import os
import resource

from hpamdp.limits import limit_in

_SHARED_MEMORY = "/dev/shm"  # where Linux keeps it


def limit_of(error: BaseException) -> str | None:
    """Return the limit that an error is about and how to raise it, as text; None if it is about no such limit."""
    limit = limit_in(error)
    if limit == "files":
        return f"too many open files (ulimit -n is {_soft(resource.RLIMIT_NOFILE)}; raise it, or use fewer workers)"
    if limit == "processes":
        return f"too many processes (ulimit -u is {_soft(resource.RLIMIT_NPROC)}; raise it, or use fewer workers)"
    return full_shared_memory() if limit == "space" else None


def full_shared_memory() -> str:
    """Return a message that shared memory is full and how to get more."""
    size = ""
    if os.path.isdir(_SHARED_MEMORY):
        disk = os.statvfs(_SHARED_MEMORY)
        size = f", {disk.f_blocks * disk.f_frsize / 1e6:,.1f} MB"
    cure = "set --shm-size of the container, or use fewer environments or collector=single"
    return f"shared memory is full ({_SHARED_MEMORY}{size}; {cure})"


def _soft(limit: int) -> str:
    value, _ = resource.getrlimit(limit)
    return "unlimited" if value == resource.RLIM_INFINITY else str(value)
