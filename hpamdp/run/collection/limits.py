"""Explain which limit of this machine keeps other processes from starting or from sharing memory."""

from __future__ import annotations

import errno
import os
import resource

_SHARED_MEMORY = "/dev/shm"  # where Linux keeps it
# Messages of Python and torch about these limits if they raise no OSError.
_NO_FILES = ("Too many open files", "received 0 items of ancdata")
_NO_PROCESSES = ("can't start new thread", "Resource temporarily unavailable")
_NO_SPACE = ("No space left on device",)


def limit_of(error: BaseException) -> str | None:
    """Return in words which limit an error is about and how to raise it; None if it is about no limit."""
    code = error.errno if isinstance(error, OSError) else None
    text = str(error) if isinstance(error, OSError | RuntimeError) else ""

    def contains(signs: tuple[str, ...]) -> bool:
        return any(sign in text for sign in signs)

    if code in (errno.EMFILE, errno.ENFILE) or contains(_NO_FILES):
        return f"too many open files (ulimit -n is {_soft(resource.RLIMIT_NOFILE)}; raise it, or use fewer workers)"
    if code == errno.EAGAIN or contains(_NO_PROCESSES):
        return f"too many processes (ulimit -u is {_soft(resource.RLIMIT_NPROC)}; raise it, or use fewer workers)"
    if code in (errno.ENOSPC, errno.EDQUOT) or contains(_NO_SPACE):
        return full_shared_memory()
    return None


def full_shared_memory() -> str:
    """Return a message that shared memory is full, and how to get more."""
    size = ""
    if os.path.isdir(_SHARED_MEMORY):
        disk = os.statvfs(_SHARED_MEMORY)
        size = f", {disk.f_blocks * disk.f_frsize / 1e6:,.1f} MB"
    cure = "set --shm-size of the container, or use fewer environments or collector=single"
    return f"shared memory is full ({_SHARED_MEMORY}{size}; {cure})"


def _soft(limit: int) -> str:
    value, _ = resource.getrlimit(limit)
    return "unlimited" if value == resource.RLIM_INFINITY else str(value)
