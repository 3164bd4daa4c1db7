"""Write nested values to a safetensors file as a whole, and read them back exactly.

The tensors are the file's tensors. Everything else is JSON in the file's metadata, with names in place of the tensors.
JSON objects with one of four keys stand for what JSON lacks:

- `{"$tensor": "agent/weight"}`: the tensor of this name;
- `{"$tuple": [...]}`: a tuple;
- `{"$dict": [[key, value], ...]}`: a mapping with keys that are no text, or begin with a dollar sign;
- `{"$float": "nan"}`: a number that is not finite.

Reading runs no code and takes no more memory than the file has bytes, apart from the JSON. Checksums find damage.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor

from hpamdp.files import replacing
from hpamdp.run_files import METADATA_KEY


def write(path: Path, state: Mapping[str, Any]) -> None:
    """Write nested dicts, lists and tuples of tensors, numbers, text and None.

    Tensors of the same memory are stored once.

    Raises:
        TypeError: a value is of another type.
        OSError: the file cannot be written; the old file stays as it is.
    """
    data = as_bytes(state)
    with replacing(path) as partial:
        partial.write_bytes(data)


def as_bytes(state: Mapping[str, Any]) -> bytes:
    """Return what `write` writes.

    Raises:
        TypeError: a value is of another type.
        RuntimeError: a tensor is sparse, or has no numbers.
        KeyError: safetensors does not know the type of a tensor.
    """
    packer = _Packer()
    content: dict[str, Any] = {"state": {name: packer.packed(name, value) for name, value in state.items()}}
    content["checksums"] = {name: _checksum(tensor) for name, tensor in packer.tensors.items()}
    content["checksum"] = _checksum_of_json(content)
    return save(packer.tensors, {METADATA_KEY: json.dumps(content, allow_nan=False)})


class _Packer:
    """Turn nested values into JSON values, and collect their tensors by name."""

    def __init__(self) -> None:
        self.tensors: dict[str, Tensor] = {}
        self._names: dict[tuple[Any, ...], str] = {}
        self._storages: set[int] = set()

    def packed(self, name: str, value: Any) -> Any:
        if isinstance(value, Tensor):
            return {"$tensor": self._named(name, value)}
        if isinstance(value, Mapping):
            parts = {key: self.packed(f"{name}/{key}", part) for key, part in value.items()}
            if all(isinstance(key, str) and not key.startswith("$") for key in parts):
                return parts
            return {"$dict": [[self.packed(name, key), part] for key, part in parts.items()]}
        if isinstance(value, list | tuple):
            items = [self.packed(f"{name}/{i}", part) for i, part in enumerate(value)]
            return items if isinstance(value, list) else {"$tuple": items}
        if isinstance(value, np.generic):
            value = value.item()
        if isinstance(value, float) and not math.isfinite(value):
            return {"$float": str(float(value))}
        if value is None or isinstance(value, bool | int | float | str):
            return value
        raise TypeError(f"{name} is of type {type(value).__name__}, which a file cannot hold")

    def _named(self, name: str, tensor: Tensor) -> str:
        """Add a tensor unless it is there already, and return its name."""
        memory = (tensor.device, tensor.data_ptr(), tensor.dtype, tensor.shape, tensor.stride())
        if memory not in self._names:
            while name in self.tensors:  # of {"a": {"b/c": ...}} and {"a/b": {"c": ...}}
                name += "_"
            self._names[memory] = name
            dense = tensor.detach().cpu().contiguous()
            storage = dense.untyped_storage().data_ptr()
            # One number counts as contiguous whatever its stride, but with some strides it has no view as bytes.
            is_copied = storage in self._storages or dense.numel() == 1
            self.tensors[name] = dense.clone(memory_format=torch.contiguous_format) if is_copied else dense
            self._storages.add(storage)
        return self._names[memory]


class StateFile:
    """A file of `write`.

    Attributes:
        names: names of the values, in their order.

    Raises:
        ValueError: the file is damaged, or `write` did not write it. A damaged file may raise other errors.
    """

    def __init__(self, path: Path) -> None:
        self._file = safe_open(path, framework="pt")
        content = json.loads(self._file.metadata()[METADATA_KEY])
        if content.pop("checksum") != _checksum_of_json(content):
            raise ValueError("the checksum of its JSON is wrong")
        self._state, self._checksums = content["state"], content["checksums"]
        self.names = (*self._state,)

    def read(self, name: str, device: torch.device | None = None) -> Any:
        """Return a value with its tensors, in memory of their own.

        Raises:
            ValueError: the value is damaged. It may raise other errors.
        """
        tensors: dict[str, Tensor] = {}

        def tensor(name: str) -> Tensor:
            if name not in tensors:
                tensors[name] = self._tensor(name).to(device or "cpu", copy=True)
            return tensors[name]

        return _unpacked(self._state[name], tensor)

    def _tensor(self, name: str) -> Tensor:
        tensor: Tensor = self._file.get_tensor(name)
        if _checksum(tensor) != self._checksums[name]:
            raise ValueError(f"the checksum of {name} is wrong")
        if tensor.dtype == torch.bool and (tensor.view(torch.uint8) > 1).any():
            raise ValueError(f"{name} holds other bytes than 0 and 1")
        return tensor


def _unpacked(value: Any, tensor: Callable[[str], Tensor]) -> Any:
    if isinstance(value, list):
        return [_unpacked(part, tensor) for part in value]
    if not isinstance(value, dict):
        return value
    match value:
        case {"$tensor": name}:
            return tensor(name)
        case {"$tuple": parts}:
            return tuple(_unpacked(parts, tensor))
        case {"$float": text}:
            return float(text)
    pairs = value.get("$dict", value.items())
    return {_unpacked(key, tensor): _unpacked(part, tensor) for key, part in pairs}


def _checksum(tensor: Tensor) -> int:
    return zlib.crc32(tensor.reshape(-1).view(torch.uint8).numpy().data)


def _checksum_of_json(content: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(content).encode())
