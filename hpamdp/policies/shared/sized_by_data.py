"""Modules whose buffers are sized by data."""

from __future__ import annotations

from typing import Any

from torch import nn


class SizedByData(nn.Module):
    """A module whose buffers are sized by data; loading a state dict resizes them to what was saved."""

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        for name, buffer in list(self.named_buffers(recurse=False)):
            saved = state_dict.get(prefix + name)
            if saved is not None and saved.shape != buffer.shape:
                self.register_buffer(name, buffer.new_zeros(saved.shape))
        super()._load_from_state_dict(state_dict, prefix, *args)
