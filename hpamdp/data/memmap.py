"""Read memory-mapped files of a tensordict as numbers only; `hpamdp.data.export` writes them.

`TensorDict.load_memmap` alone unpickles objects, builds a class that a file names, and follows links. A file that is
too short crashes the interpreter. So `load` checks every file before it maps any.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, NonNegativeInt, TypeAdapter, ValidationError
from pydantic_core import from_json
from tensordict import TensorDict

from hpamdp.data import DataError
from hpamdp.files import read_regular, regular_size
from hpamdp.messages import reason_of

_META = "meta.json"
_MAX_META_BYTES = 1 << 20
_DTYPES = {str(dtype): dtype for dtype in (torch.bool, torch.int32, torch.int64, torch.float32, torch.float64)}


class _Leaf(BaseModel):
    """A tensor in a file of its own."""

    model_config = ConfigDict(strict=True, extra="forbid")

    shape: list[NonNegativeInt]
    dtype: Literal[tuple(_DTYPES)]  # type: ignore[valid-type]
    device: Literal["cpu"]
    is_nested: Literal[False]


class _Folder(BaseModel):
    """A tensordict in a folder of its own."""

    model_config = ConfigDict(strict=True, extra="forbid")

    type: Literal["TensorDict"]


_ENTRY: TypeAdapter[_Leaf | _Folder] = TypeAdapter(_Leaf | _Folder)


def load(folder: Path) -> TensorDict:
    """Map a tensordict `[N]` of numbers.

    Raises:
        DataError: a file is missing, is no regular file, has a wrong size, or holds something else.
    """
    try:
        _check(folder)
        return TensorDict.load_memmap(folder, allow_pickle=False)
    except OSError as error:
        raise DataError(f"{error.filename or folder}: {reason_of(error)}") from error


def _check(folder: Path, num_rows: int | None = None) -> None:
    file = folder / _META
    try:
        meta = from_json(read_regular(file, _MAX_META_BYTES, follow_links=False), allow_inf_nan=False)
    except ValueError as error:
        raise DataError(f"{file}: no JSON") from error
    if not isinstance(meta, dict) or meta.pop("_type", None) != str(TensorDict):
        raise DataError(f"{file}: not of a plain TensorDict")
    shape, device = meta.pop("shape", None), meta.pop("device", None)
    is_length = isinstance(shape, list) and len(shape) == 1 and type(shape[0]) is int and shape[0] > 0
    if not is_length or device not in ("cpu", "None") or num_rows not in (None, shape[0]):
        raise DataError(f"{file}: shape {shape} on {device}, but must be [{num_rows or 'N'}] on cpu")
    for name, value in meta.items():
        _check_entry(folder, name, value, shape[0])


def _check_entry(folder: Path, name: str, value: Any, num_rows: int) -> None:
    if re.fullmatch(r"\w+", name, re.ASCII) is None:
        raise DataError(f"{folder / _META}: {name[:40]!r} is no name of an entry")
    try:
        entry = _ENTRY.validate_python(value)
    except ValidationError as error:
        raise DataError(f"{folder / _META}: {name} is not described as a tensor of numbers") from error
    if isinstance(entry, _Folder):
        if (folder / name).is_symlink():
            raise DataError(f"{folder / name}: is a link")
        _check(folder / name, num_rows)
        return
    file = folder / f"{name}.memmap"
    if entry.shape[:1] != [num_rows]:
        raise DataError(f"{folder / _META}: {name} has shape {entry.shape}, but must have {num_rows} rows")
    expected = math.prod(entry.shape) * _DTYPES[entry.dtype].itemsize
    found = regular_size(file, follow_links=False)
    if found != expected:
        raise DataError(f"{file}: {found} bytes, but must have {expected}")
