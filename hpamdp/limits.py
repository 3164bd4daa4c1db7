"""Recognise the limits of a process or of a machine in the errors of any library, and say how to raise them."""

from __future__ import annotations

import errno
import os
import resource
from typing import Literal

Limit = Literal["files", "processes", "space"]
_CODES: dict[int, Limit] = {
    errno.EMFILE: "files",
    errno.ENFILE: "files",
    errno.EAGAIN: "processes",
    errno.ENOSPC: "space",
    errno.EDQUOT: "space",
}
# Messages of libraries about these limits, in errors without a number.
_SIGNS: dict[str, Limit] = {
    "Too many open files": "files",
    "received 0 items of ancdata": "files",
    "can't start new thread": "processes",
    "Resource temporarily unavailable": "processes",
    "No space left on device": "space",
}
# Messages of torch about a tensor that is larger than memory, or has more bytes than torch can count.
_OF_TENSORS = (
    "allocate memory",
    "out of memory",
    "Unable to allocate",
    "calculation overflowed",
    "multiplication overflow",
    "too big to convert",
    "Overflow when unpacking long",
    "cannot be represented as a SymInt",
    "numel needs to be smaller than",
    "invalid size",
)
_SHARED_MEMORY = "/dev/shm"  # where Linux keeps it


def limit_in(error: BaseException) -> Limit | None:
    """Return the limit that an error is about; None if it is about no limit."""
    code = getattr(error, "errno", None)
    if code in _CODES:
        return _CODES[code]
    text = str(error) if isinstance(error, OSError | RuntimeError | ImportError) else ""
    return next((limit for sign, limit in _SIGNS.items() if sign in text), None)


def is_about_memory(error: BaseException) -> bool:
    """Return whether an error is about too little memory for a tensor."""
    if isinstance(error, MemoryError):
        return True
    is_kind = isinstance(error, RuntimeError | OverflowError | ValueError)
    return is_kind and any(sign in str(error) for sign in _OF_TENSORS)


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
