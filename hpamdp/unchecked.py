"""Tensordicts without the checks of TensorDict's constructor, which take longer than a small problem's step."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase


def unchecked(leaves: dict[str, Any], like: TensorDictBase | EnvBase) -> TensorDict:
    """Return leaves as a tensordict with the batch size and the device of `like`, which they must have."""
    return TensorDict._new_unsafe(leaves, batch_size=like.batch_size, device=like.device)
