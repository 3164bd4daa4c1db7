"""Recognise the limits of a process or of a machine in the errors of any library, and say how to raise them."""

from __future__ import annotations

_FILES = "too many open files; raise ulimit -n, or use fewer workers"
_PROCESSES = "too many processes; raise ulimit -u, or use fewer workers"
SHARED_MEMORY = (
    "shared memory is full (/dev/shm); set --shm-size of the container, or use fewer environments or collector=single"
)
# Messages of the system and of libraries about limits.
_LIMITS = {
    "Too many open files": _FILES,
    "received 0 items of ancdata": _FILES,
    "can't start new thread": _PROCESSES,
    "Resource temporarily unavailable": _PROCESSES,
    "No space left on device": SHARED_MEMORY,
    "Disk quota exceeded": SHARED_MEMORY,
}


def is_about_memory(error: BaseException) -> bool:
    """Return whether an error is about too little memory for a tensor."""
    signs = ("allocate memory", "out of memory", "Unable to allocate")
    is_torchs = isinstance(error, RuntimeError) and any(sign in str(error) for sign in signs)
    return is_torchs or isinstance(error, MemoryError)


def limit_of(error: BaseException) -> str | None:
    """Return the limit that an error is about and how to raise it, as text; None if it is about no such limit."""
    text = str(error) if isinstance(error, OSError | RuntimeError | ImportError) else ""
    return next((cure for sign, cure in _LIMITS.items() if sign in text), None)
