"""Read files of `torch.save` without running code, and with little more memory than the file has bytes.

`torch.load(weights_only=True)` runs no code either. But it allocates the sizes that a file claims and decompresses
members without a limit. Before torch 2.10 it also trusts the length of a storage. A `TensorArchive` first reads a
description: nested values with a `SavedTensor` in place of each tensor. The caller checks the description, and then
reads the tensors. The description has a largest number of instructions, since an instruction of one byte can make a
dict of 64 bytes. A tensor takes its bytes twice while it is read.
"""

from __future__ import annotations

import io
import math
import pickletools
import sys
import zipfile
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import IO, Any

import torch
from torch import Tensor

# How many numbers the tensors of a storage may have together, in sizes of the storage. Shared weights occur repeatedly.
_MAX_USES = 16
_DTYPES = {
    "DoubleStorage": torch.float64,
    "FloatStorage": torch.float32,
    "HalfStorage": torch.float16,
    "BFloat16Storage": torch.bfloat16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ShortStorage": torch.int16,
    "CharStorage": torch.int8,
    "ByteStorage": torch.uint8,
    "BoolStorage": torch.bool,
}
_ORDERED_DICT, _REBUILD = object(), object()
_MAX_DIMS = 16
# Any archive may have the first number of instructions, and one more for each 8 bytes. A tensor takes some 25, and at
# least 350 bytes.
_FEW_INSTRUCTIONS, _BYTES_AN_INSTRUCTION = 200_000, 8
_BLOCK = 2**20


@dataclass(frozen=True)
class SavedTensor:
    """The description of a tensor that has not been read yet.

    Attributes:
        dtype, shape, stride, offset: dtype, shape, stride and storage offset of the tensor.
        record: member of the archive that holds the tensor's numbers.
    """

    dtype: torch.dtype
    shape: tuple[int, ...]
    stride: tuple[int, ...]
    offset: int
    record: str


@dataclass(frozen=True)
class _Storage:
    dtype: torch.dtype
    num: int
    record: str


def stored_members(file: IO[bytes], num_bytes: int) -> zipfile.ZipFile:
    """Open a zip archive of `num_bytes` whose members are stored without compression.

    Raises:
        ValueError: a member is compressed, has the name of another member, or is larger than the file.
    """
    archive = zipfile.ZipFile(file)
    infos = archive.infolist()
    names = Counter(info.filename for info in infos)
    for info in infos:
        if info.compress_type != zipfile.ZIP_STORED or info.compress_size != info.file_size:
            raise ValueError(f"{info.filename} is compressed")
        if names[info.filename] > 1:
            raise ValueError(f"{info.filename} is there twice")
    if sum(info.file_size for info in infos) > num_bytes:
        raise ValueError("its members are larger than the file")
    return archive


class MemberFile(io.RawIOBase):
    """Present a stored member of a zip archive as a file that seeks without reading."""

    def __init__(self, file: IO[bytes], info: zipfile.ZipInfo) -> None:
        super().__init__()
        file.seek(info.header_offset)
        header = file.read(30)
        self._file = file
        self._start = info.header_offset + 30 + sum(int.from_bytes(header[i : i + 2], "little") for i in (26, 28))
        self.num_bytes = info.file_size
        self._place = 0

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return the place of the next byte."""
        return self._place

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Set the place of the next byte, and return it."""
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._place, io.SEEK_END: self.num_bytes}[whence]
        self._place = max(0, start + offset)
        return self._place

    def readinto(self, buffer: Any) -> int:
        """Read into a buffer, and return the number of bytes read."""
        self._file.seek(self._start + self._place)
        data = self._file.read(min(len(buffer), max(0, self.num_bytes - self._place)))
        buffer[: len(data)] = data
        self._place += len(data)
        return len(data)


class TensorArchive:
    """An archive that `torch.save` wrote.

    Args:
        file: the archive.
        num_bytes: size of the file.

    Attributes:
        state: the saved value, with a `SavedTensor` in place of each tensor.

    Raises:
        ValueError: the file holds other values than dicts, lists, tuples, strings, numbers and plain tensors. A
            damaged file may raise other errors.
    """

    def __init__(self, file: IO[bytes], num_bytes: int) -> None:
        self._archive = stored_members(file, num_bytes)
        sizes = {info.filename: info.file_size for info in self._archive.infolist()}
        (script,) = [name for name in sizes if name.endswith("/data.pkl")]
        folder = script.removesuffix("data.pkl")
        order = f"{folder}byteorder"
        if order in sizes and self._archive.read(order) != sys.byteorder.encode():
            raise ValueError("its numbers have another byte order")
        most = _FEW_INSTRUCTIONS + num_bytes // _BYTES_AN_INSTRUCTION
        self.state: Any = _Reader(self._archive.read(script), folder, sizes, most).read()

    def tensor(self, saved: SavedTensor, device: torch.device | None = None) -> Tensor:
        """Read a tensor.

        Raises:
            ValueError: a bool tensor has bytes other than 0 and 1.
        """
        data = self._bytes(saved.record)
        dtype = torch.uint8 if saved.dtype == torch.bool else saved.dtype
        flat = torch.frombuffer(data, dtype=dtype) if data else torch.empty(0, dtype=dtype)
        if saved.dtype == torch.bool:
            if (flat > 1).any():
                raise ValueError(f"{saved.record} holds other bytes than 0 and 1")
            flat = flat.bool()
        return flat.as_strided(saved.shape, saved.stride, saved.offset).clone().to(device)

    def _bytes(self, record: str) -> bytearray:
        """Read a member piece by piece, which takes no copy of it as `ZipFile.read` would."""
        data = bytearray(self._archive.getinfo(record).file_size)
        view = memoryview(data)
        with self._archive.open(record) as member:
            for start in range(0, len(data), _BLOCK):
                piece = member.read(len(view[start : start + _BLOCK]))
                view[start : start + len(piece)] = piece
        return data

    def filled(self, value: Any, device: torch.device | None = None) -> Any:
        """Return a nested value of `state` with its tensors read."""
        if isinstance(value, SavedTensor):
            return self.tensor(value, device)
        if isinstance(value, Mapping):
            return {name: self.filled(part, device) for name, part in value.items()}
        if isinstance(value, list | tuple):
            return type(value)(self.filled(part, device) for part in value)
        return value


class _Reader:
    """Build nested values from the instructions that `torch.save` writes, without calling anything by its name.

    Args:
        script: the instructions.
        folder: the folder of the archive's members.
        sizes: number of bytes of each member.
        most: number of instructions that there may be.
    """

    def __init__(self, script: bytes, folder: str, sizes: Mapping[str, int], most: int) -> None:
        self._script = script
        self._most = most
        self._folder = folder
        self._sizes = sizes
        self._used: Counter[str] = Counter()
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def read(self) -> Any:
        """Return the saved value.

        Raises:
            ValueError: an instruction is unknown, or a value does not fit the archive.
        """
        for number, (instruction, argument, _) in enumerate(pickletools.genops(self._script)):
            if number == self._most:
                raise ValueError(f"its description has more than {self._most:,} instructions")
            self._follow(instruction.name, argument)
        (value,) = self._stack
        return value

    def _follow(self, name: str, argument: Any) -> None:  # noqa: C901, PLR0912  (one case for each instruction)
        stack = self._stack
        match name:
            case "PROTO" | "STOP":
                pass
            case "NONE" | "NEWTRUE" | "NEWFALSE":
                stack.append({"NONE": None, "NEWTRUE": True, "NEWFALSE": False}[name])
            case "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT" | "BINUNICODE":
                stack.append(argument)
            case "MARK":
                self._marks.append(len(stack))
            case "EMPTY_LIST":
                stack.append([])
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_TUPLE":
                stack.append(())
            case "TUPLE":
                stack.append(tuple(self._since_mark()))
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                num = int(name[-1])
                stack[-num:] = [tuple(stack[-num:])]
            case "APPEND":
                self._extend([stack.pop()])
            case "APPENDS":
                self._extend(self._since_mark())
            case "SETITEM":
                self._update([stack.pop(-2), stack.pop()])
            case "SETITEMS":
                self._update(self._since_mark())
            case "BINPUT" | "LONG_BINPUT":
                self._memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(self._again(argument))
            case "GLOBAL":
                stack.append(self._named(argument))
            case "BINPERSID":
                stack.append(self._storage(*stack.pop()))
            case "REDUCE":
                arguments = stack.pop()
                stack.append(self._made(stack.pop(), arguments))
            case "BUILD":  # the `_metadata` of a state dict
                stack.pop()
            case _:
                raise ValueError(f"{name} is no instruction for tensors")

    def _since_mark(self) -> list[Any]:
        mark = self._marks.pop()
        values = self._stack[mark:]
        del self._stack[mark:]
        return values

    def _extend(self, values: list[Any]) -> None:
        if not isinstance(self._stack[-1], list):
            raise ValueError("it appends to something that is no list")
        self._stack[-1].extend(values)

    def _update(self, values: list[Any]) -> None:
        if not isinstance(self._stack[-1], dict):
            raise ValueError("it sets an entry of something that is no dict")
        self._stack[-1].update(zip(values[::2], values[1::2], strict=True))

    def _again(self, number: int) -> Any:
        """Return a value that occurs again, but refuse a container, because contents could grow exponentially."""
        value = self._memo[number]
        parts = value if isinstance(value, tuple) else ()
        if isinstance(value, dict | list) or not all(type(part) is int for part in parts):
            raise ValueError("a container occurs twice in it")
        return value

    def _named(self, name: str) -> Any:
        module, _, name = name.partition(" ")
        if module == "torch" and name in _DTYPES:
            return _DTYPES[name]
        known = {("collections", "OrderedDict"): _ORDERED_DICT, ("torch._utils", "_rebuild_tensor_v2"): _REBUILD}
        if (module, name) not in known:
            raise ValueError(f"it names {module}.{name}, which is no tensor")
        return known[module, name]

    def _storage(self, kind: Any, dtype: Any, key: Any, device: Any, num: Any) -> _Storage:
        record = f"{self._folder}data/{key}"
        if kind != "storage" or not isinstance(dtype, torch.dtype) or type(num) is not int:
            raise ValueError("it refers to something that is no storage")
        if self._sizes[record] != num * dtype.itemsize:
            raise ValueError(f"{record} has another length than its storage")
        return _Storage(dtype, num, record)

    def _made(self, function: Any, arguments: Any) -> Any:
        if function is _ORDERED_DICT and arguments == ():
            return {}
        if function is _REBUILD:
            return self._tensor(*arguments)
        raise ValueError("it calls something that makes no tensor")

    def _tensor(
        self, storage: Any, offset: Any, shape: Any, stride: Any, requires_grad: Any, hooks: Any
    ) -> SavedTensor:
        if not isinstance(storage, _Storage) or len(shape) != len(stride) or len(shape) > _MAX_DIMS:
            raise ValueError("a tensor in it has no storage or no shape")
        if not all(type(number) is int and number >= 0 for number in (offset, *shape, *stride)):
            raise ValueError("the sizes of a tensor in it are not whole numbers")
        num = math.prod(shape)
        last = offset + sum((size - 1) * step for size, step in zip(shape, stride, strict=True)) if num else 0
        is_expanded = any(step == 0 and size > 1 for size, step in zip(shape, stride, strict=True))
        if is_expanded or num > storage.num or (num and last >= storage.num):
            raise ValueError(f"a tensor of shape {list(shape)} has a storage of {storage.num} numbers")
        self._used[storage.record] += num
        if self._used[storage.record] > _MAX_USES * storage.num:
            raise ValueError(f"too many tensors share {storage.record}")
        return SavedTensor(storage.dtype, tuple(shape), tuple(stride), offset, storage.record)
