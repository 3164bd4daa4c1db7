"""Recognise the limits of a process or of a machine in the errors of any library, and say how to raise them."""

from __future__ import annotations

import os
import resource

# Messages of the system and of libraries about limits.
_OF_FILES = ("Too many open files", "received 0 items of ancdata")
_OF_PROCESSES = ("can't start new thread", "Resource temporarily unavailable")
_OF_SPACE = ("No space left on device", "Disk quota exceeded")
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


def is_about_memory(error: BaseException) -> bool:
    """Return whether an error is about too little memory for a tensor."""
    if isinstance(error, MemoryError):
        return True
    is_kind = isinstance(error, RuntimeError | OverflowError | ValueError)
    return is_kind and any(sign in str(error) for sign in _OF_TENSORS)


def limit_of(error: BaseException) -> str | None:
    """Return the limit that an error is about and how to raise it, as text; None if it is about no such limit."""
    text = str(error) if isinstance(error, OSError | RuntimeError | ImportError) else ""
    if any(sign in text for sign in _OF_FILES):
        return f"too many open files (ulimit -n is {_soft(resource.RLIMIT_NOFILE)}; raise it, or use fewer workers)"
    if any(sign in text for sign in _OF_PROCESSES):
        return f"too many processes (ulimit -u is {_soft(resource.RLIMIT_NPROC)}; raise it, or use fewer workers)"
    return full_shared_memory() if any(sign in text for sign in _OF_SPACE) else None


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
