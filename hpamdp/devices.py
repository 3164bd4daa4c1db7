"""Check the devices that Python code gives to constructors."""

from __future__ import annotations

from typing import Any, TypeAlias

import torch

from hpamdp.messages import as_code, first_line
from hpamdp.settings import SettingError

Device: TypeAlias = torch.device | str


def checked_device(owner: object, device: Any) -> torch.device:
    """Return a device on which this machine can make tensors.

    Args:
        owner: whose constructor got the device.
        device: its argument `device`.

    Raises:
        SettingError: it is no device of torch, or this machine does not have it.
    """
    try:
        torch.empty(0, device=device, dtype=torch.float32)
        return torch.device(device)
    except (RuntimeError, AssertionError, TypeError) as error:  # of torch, which lists its kinds of devices
        given = as_code(str(device) if isinstance(device, torch.device) else device)
        raise SettingError(f"{type(owner).__name__}: device={given}: {first_line(error)}; use cpu or cuda:N") from error
