"""Check the devices that Python code gives to constructors."""

from __future__ import annotations

from typing import Any

import torch

from hpamdp.messages import as_code
from hpamdp.settings import SettingError


def checked_device(owner: object, device: Any) -> torch.device:
    """Return a device on which this machine can make tensors.

    Args:
        owner: whose constructor got the device.
        device: its argument `device`.

    Raises:
        SettingError: it is no device of torch, or this machine does not have it.
    """
    given = f"{type(owner).__name__}: device={as_code(str(device) if isinstance(device, torch.device) else device)}"
    if isinstance(device, bool) or not isinstance(device, str | int | torch.device):
        raise SettingError(f"{given}: must be cpu, cuda, cuda:N or another device of torch")
    try:
        named = torch.device(device)
    except RuntimeError as error:
        raise SettingError(f"{given}: must be cpu, cuda, cuda:N or another device of torch") from error
    try:
        torch.empty(0, device=named, dtype=torch.float32)
    except (RuntimeError, AssertionError) as error:  # torch without CUDA raises the latter
        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        there = f"has CUDA devices 0 to {count - 1}" if count else "has no usable CUDA device"
        raise SettingError(f"{given}: not on this machine, which {there}; use cpu") from error
    return named
