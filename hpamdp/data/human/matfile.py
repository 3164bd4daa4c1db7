"""The part of MATLAB's level 5 MAT format that the human data uses, read with every length checked first.

Not SciPy's reader, because a file may be damaged: on cells nested 30,000 deep that one crashes the interpreter, and on
a cell array whose header claims 2^30 entries it takes 8 GB. Here nothing is believed that the bytes do not hold, and an
array is opened only when it is asked for. Compressed and plain arrays of numbers, cells and structs are understood, in
little-endian order. Source: MathWorks, *MAT-File Format*, "Level 5 MAT-File Format".
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hpamdp.data.human.errors import HumanDataError

_HEADER_BYTES = 128
_CELL, _STRUCT, _NUMERIC = 1, 2, range(6, 16)
_INT8, _INT32, _UINT32, _MATRIX, _COMPRESSED = 1, 5, 6, 14, 15
_COMPLEX = 0x0800
_FORMATS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}
_DTYPES = {code: np.dtype(name) for code, name in _FORMATS.items()}
_MAX_INFLATED = 64 * 2**20  # bytes; the released file has about 20 million
_MAX_OTHERS = 100  # variables looked at before the one that is wanted; the released file has no other

_tag = struct.Struct("<II").unpack_from


class _Element(NamedTuple):
    type: int
    content: memoryview
    end: int  # where the next element begins


def _element(data: memoryview, offset: int) -> _Element:
    """Return the data element at an offset."""
    if offset + 8 > len(data):
        raise HumanDataError(f"an element is cut off at byte {offset}")
    kind, size = _tag(data, offset)
    if kind >> 16:  # a small element: four bytes of content at most, inside the tag
        kind, size, start = kind & 0xFFFF, kind >> 16, offset + 4
        end = offset + 8
        if size > 4:
            raise HumanDataError(f"a small element at byte {offset} claims {size} bytes")
    else:
        start = offset + 8
        end = start + size + (-size % 8 if kind != _COMPRESSED else 0)
        if start + size > len(data):
            raise HumanDataError(f"an element at byte {offset} claims {size} bytes, but {len(data) - start} are left")
    return _Element(kind, data[start : start + size], end)


class MatArray:
    """An array of a MAT file, opened as far as its header: `name`, `shape` and what `numbers`, `cells`, `fields` give.

    Raises:
        HumanDataError: the bytes are no such array.
    """

    def __init__(self, content: memoryview) -> None:
        flags = _element(content, 0)
        dims = _element(content, flags.end)
        name = _element(content, dims.end)
        if flags.type != _UINT32 or len(flags.content) != 8:
            raise HumanDataError("an array has no flags")
        if dims.type != _INT32 or len(dims.content) % 4 or not 8 <= len(dims.content) <= 128:
            raise HumanDataError("an array has no dimensions")
        if name.type != _INT8:
            raise HumanDataError("an array has no name")
        (word, _) = _tag(flags.content)
        self._kind, self._is_complex = word & 0xFF, bool(word & _COMPLEX)
        self.shape: tuple[int, ...] = struct.unpack(f"<{len(dims.content) // 4}i", dims.content)
        if min(self.shape) < 0:
            raise HumanDataError(f"an array has a negative dimension in {self.shape}")
        self.size = math.prod(self.shape)
        self.name = bytes(name.content).decode("latin-1")
        self._content, self._start = content, name.end

    def numbers(self) -> np.ndarray:
        """Return a numeric array's values, column by column, `[size]` float64."""
        if self._kind not in _NUMERIC or self._is_complex:
            raise HumanDataError(f"an array of class {self._kind} stands where real numbers belong")
        values = _element(self._content, self._start)
        dtype = _DTYPES.get(values.type)
        if dtype is None or len(values.content) != self.size * dtype.itemsize:
            raise HumanDataError(f"{self.size} numbers do not fill {len(values.content)} bytes of type {values.type}")
        return np.frombuffer(values.content, dtype).astype(np.float64)

    def cells(self) -> Iterator[MatArray]:
        """Yield a cell array's arrays, column by column."""
        if self._kind != _CELL:
            raise HumanDataError(f"an array of class {self._kind} stands where a cell array belongs")
        yield from self._arrays(self._start, self.size)

    def fields(self) -> dict[str, MatArray]:
        """Return the fields of a struct of size 1."""
        if self._kind != _STRUCT or self.size != 1:
            raise HumanDataError(f"an array of class {self._kind} and size {self.size} stands where one struct belongs")
        length = _element(self._content, self._start)
        names = _element(self._content, length.end)
        if length.type != _INT32 or len(length.content) != 4 or names.type != _INT8:
            raise HumanDataError("a struct has no field names")
        (width,) = struct.unpack("<i", length.content)
        if width < 1 or len(names.content) % width:
            raise HumanDataError(f"a struct's field names are {width} bytes wide")
        text = bytes(names.content)
        found = [text[i : i + width].split(b"\0")[0].decode("latin-1") for i in range(0, len(text), width)]
        if len(set(found)) != len(found):
            raise HumanDataError("a struct has two fields of one name")
        return dict(zip(found, self._arrays(names.end, len(found)), strict=True))

    def _arrays(self, offset: int, num: int) -> Iterator[MatArray]:
        if num * 8 > len(self._content) - offset:
            raise HumanDataError(f"{num} arrays do not fit into {len(self._content) - offset} bytes")
        for _ in range(num):
            element = _element(self._content, offset)
            if element.type != _MATRIX:
                raise HumanDataError(f"an element of type {element.type} stands where an array belongs")
            yield MatArray(element.content)
            offset = element.end


def read_variable(data: bytes, name: str) -> MatArray:
    """Return the variable of a MAT file's bytes that has this name.

    Raises:
        HumanDataError: the bytes are no such file or hold no such variable.
    """
    if len(data) < _HEADER_BYTES or data[124:128] != b"\x00\x01IM":
        raise HumanDataError("this is no MATLAB file of level 5 in little-endian order")
    view, offset, inflated, others = memoryview(data), _HEADER_BYTES, 0, []
    while offset < len(data):
        element = _element(view, offset)
        offset = element.end
        if element.type == _COMPRESSED:
            content = _inflate(element.content, _MAX_INFLATED - inflated)
            inflated += len(content)
            element = _element(content, 0)
        if element.type != _MATRIX:
            raise HumanDataError(f"an element of type {element.type} stands where a variable belongs")
        array = MatArray(element.content)
        if array.name == name:
            return array
        others.append(array.name)
        if len(others) > _MAX_OTHERS:
            break
    raise HumanDataError(f"there is no variable {name}, but {some(others) or 'none at all'}")


def some(names: Sequence[str]) -> str:
    """Return names to be told in a message, however many and long they are."""
    return ", ".join(repr(name[:20]) for name in names[:20]) + ", …" * (len(names) > 20)


def _inflate(compressed: memoryview, limit: int) -> memoryview:
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(compressed, limit + 1)
    except zlib.error as error:
        raise HumanDataError(f"a compressed variable is damaged ({error})") from error
    if len(content) > limit:
        raise HumanDataError(f"the variables take more than {_MAX_INFLATED} bytes when inflated")
    if not stream.eof:
        raise HumanDataError("a compressed variable is cut off")
    return memoryview(content)
