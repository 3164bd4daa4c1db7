"""Measure the memory of a device, and recognise errors about memory that does not suffice."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

# Files with a container's memory limit on Linux, for both versions of control groups.
_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))
# Messages of torch about a tensor that is larger than memory, or has more bytes than torch can count.
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
    """Return the device's memory in bytes; of the CPU's memory, as much as this process may use."""
    if device.type == "cuda":
        import torch

        return torch.cuda.get_device_properties(device).total_memory
    sizes = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    for file in _LIMITS:
        with suppress(OSError, ValueError):  # not there, or without a limit
            sizes.append(int(file.read_text()))
    return min(sizes)


def is_about_memory(error: BaseException) -> bool:
    """Return whether an error is about too little memory."""
    if isinstance(error, MemoryError):
        return True
    return isinstance(error, RuntimeError | OverflowError | ValueError) and any(sign in str(error) for sign in _SIGNS)


def in_gigabytes(size: float) -> str:
    """Return a number of bytes as text in gigabytes."""
    return f"{size / 1e9:,.1f} GB"
