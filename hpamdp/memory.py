"""How much memory there is, and which errors say that it does not suffice."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

# Where Linux writes a container's limit, by the version of its control groups.
_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
# What torch says of a tensor that is larger than memory, or than any number of bytes that it can count.
_SIGNS = (
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


def total_memory(device: torch.device) -> int:
    """Return how many bytes the device has; of the CPU's memory, those that this process may use."""
    if device.type == "cuda":
        import torch

        return torch.cuda.get_device_properties(device).total_memory
    sizes = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for file in _LIMITS:
        with suppress(OSError, ValueError):  # not there, or without a limit
            sizes.append(int(file.read_text()))
    return min(sizes)


def is_about_memory(error: BaseException) -> bool:
    """Return whether an error says that something is larger than memory."""
    if isinstance(error, MemoryError):
        return True
    return isinstance(error, RuntimeError | OverflowError | ValueError) and any(sign in str(error) for sign in _SIGNS)


def in_gigabytes(size: float) -> str:
    """Return a number of bytes in words."""
    return f"{size / 1e9:,.1f} GB"
