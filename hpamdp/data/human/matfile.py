"""A bounded reader of the part of MATLAB's level 5 MAT format that the recording uses.

A damaged file can break SciPy's reader: cells nested 30,000 deep crash the interpreter, and a cell array whose header
claims 2^30 entries takes 8 GB. This reader checks every length against the bytes of the file, and opens an array only
if its contents are needed. It reads numeric arrays, cells and structs, compressed or not, in little-endian order.
Source: MathWorks, *MAT-File Format*, "Level 5 MAT-File Format".
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hpamdp.data.errors import DataError

_HEADER_BYTES = 128
# Classes of arrays.
_CELL = 1
_STRUCT = 2
_NUMERIC = range(6, 16)
_COMPLEX = 0x0800  # a flag beside the class
# Types of data elements.
_INT8 = 1
_INT32 = 5
_UINT32 = 6
_MATRIX = 14
_COMPRESSED = 15
_FORMATS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}
_DTYPES = {code: np.dtype(name) for code, name in _FORMATS.items()}
_MAX_INFLATED = 64 * 2**20  # bytes; the released file takes about 20 million
_MAX_OTHERS = 100  # largest number of variables before the wanted one; the released file has no other variable

_tag = struct.Struct("<II").unpack_from  # an element's type and size


class _Element(NamedTuple):
    type: int
    content: memoryview
    end: int  # offset of the next element


def _element(data: memoryview, offset: int) -> _Element:
    """Return the data element at an offset."""
    if offset + 8 > len(data):
        raise DataError(f"an element is cut off at byte {offset}")
    kind, size = _tag(data, offset)
    if kind >> 16:  # a small element, with at most four bytes of content inside the tag
        size = kind >> 16
        kind &= 0xFFFF
        start = offset + 4
        end = offset + 8
        if size > 4:
            raise DataError(f"a small element at byte {offset} claims {size} bytes")
    else:
        start = offset + 8
        padding = 0 if kind == _COMPRESSED else -size % 8
        end = start + size + padding
        if start + size > len(data):
            raise DataError(f"an element at byte {offset} claims {size} bytes, but {len(data) - start} are left")
    return _Element(kind, data[start : start + size], end)


class MatArray:
    """An array of a MAT file. Only its header is read. `numbers`, `cells` and `fields` read the contents.

    Args:
        content: the bytes of the array's element.

    Attributes:
        name: the variable's name, empty inside cells and structs.
        shape: the dimensions.
        size: their product.

    Raises:
        DataError: the bytes are not an array.
    """

    def __init__(self, content: memoryview) -> None:
        flags = _element(content, 0)
        dims = _element(content, flags.end)
        name = _element(content, dims.end)
        if flags.type != _UINT32 or len(flags.content) != 8:
            raise DataError("an array has no flags")
        if dims.type != _INT32 or len(dims.content) % 4 or not 8 <= len(dims.content) <= 128:
            raise DataError("an array has no dimensions")
        if name.type != _INT8:
            raise DataError("an array has no name")
        (word, _) = _tag(flags.content)
        self._kind = word & 0xFF
        self._is_complex = bool(word & _COMPLEX)
        self.shape: tuple[int, ...] = struct.unpack(f"<{len(dims.content) // 4}i", dims.content)
        if min(self.shape) < 0:
            raise DataError(f"an array has a negative dimension in {self.shape}")
        self.size = math.prod(self.shape)
        self.name = bytes(name.content).decode("latin-1")
        self._content = content
        self._start = name.end

    def numbers(self) -> np.ndarray:
        """Return the values of a numeric array, column by column, float64 `[size]`.

        Raises:
            DataError: the array has no real numbers, or its bytes are damaged.
        """
        if self._kind not in _NUMERIC or self._is_complex:
            raise DataError(f"an array of class {self._kind} where real numbers were expected")
        values = _element(self._content, self._start)
        dtype = _DTYPES.get(values.type)
        if dtype is None or len(values.content) != self.size * dtype.itemsize:
            raise DataError(f"{len(values.content)} bytes of type {values.type} are not {self.size} numbers")
        return np.frombuffer(values.content, dtype).astype(np.float64)

    def cells(self) -> Iterator[MatArray]:
        """Yield the arrays in a cell array, column by column.

        Raises:
            DataError: the array is not a cell array, or its bytes are damaged.
        """
        if self._kind != _CELL:
            raise DataError(f"an array of class {self._kind} where a cell array was expected")
        yield from self._arrays(self._start, self.size)

    def fields(self) -> dict[str, MatArray]:
        """Return the fields of a struct of size 1 by name.

        Raises:
            DataError: the array is not such a struct, or its bytes are damaged.
        """
        if self._kind != _STRUCT or self.size != 1:
            raise DataError(f"an array of class {self._kind} and size {self.size} where one struct was expected")
        length = _element(self._content, self._start)
        names = _element(self._content, length.end)
        if length.type != _INT32 or len(length.content) != 4 or names.type != _INT8:
            raise DataError("a struct has no field names")
        (width,) = struct.unpack("<i", length.content)
        if width < 1 or len(names.content) % width:
            raise DataError(f"a struct's field names are {width} bytes wide")
        text = bytes(names.content)
        padded = [text[i : i + width] for i in range(0, len(text), width)]
        field_names = [name.split(b"\0")[0].decode("latin-1") for name in padded]
        if len(set(field_names)) != len(field_names):
            raise DataError("a struct has two fields of the same name")
        return dict(zip(field_names, self._arrays(names.end, len(field_names)), strict=True))

    def _arrays(self, offset: int, num: int) -> Iterator[MatArray]:
        if num * 8 > len(self._content) - offset:
            raise DataError(f"{num} arrays do not fit into {len(self._content) - offset} bytes")
        for _ in range(num):
            element = _element(self._content, offset)
            if element.type != _MATRIX:
                raise DataError(f"an element of type {element.type} where an array was expected")
            yield MatArray(element.content)
            offset = element.end


def read_variable(data: bytes, name: str) -> MatArray:
    """Return a variable of a MAT file.

    Args:
        data: the file's bytes.
        name: the variable's name.

    Raises:
        DataError: the bytes are not a MAT file, or it has no such variable.
    """
    if len(data) < _HEADER_BYTES or data[124:128] != b"\x00\x01IM":
        raise DataError("this is not a MATLAB file of level 5 in little-endian order")
    view = memoryview(data)
    offset = _HEADER_BYTES
    inflated = 0
    others: list[str] = []
    while offset < len(data):
        element = _element(view, offset)
        offset = element.end
        if element.type == _COMPRESSED:
            content = _inflate(element.content, _MAX_INFLATED - inflated)
            inflated += len(content)
            element = _element(content, 0)
        if element.type != _MATRIX:
            raise DataError(f"an element of type {element.type} where a variable was expected")
        array = MatArray(element.content)
        if array.name == name:
            return array
        others.append(array.name)
        if len(others) > _MAX_OTHERS:
            break
    raise DataError(f"there is no variable {name}; the file has {some(others) or 'none'}")


def some(names: Sequence[str]) -> str:
    """Return the names for a message, shortened if they are too many or too long."""
    return ", ".join(repr(name[:20]) for name in names[:20]) + ", …" * (len(names) > 20)


def _inflate(compressed: memoryview, limit: int) -> memoryview:
    stream = zlib.decompressobj()
    try:
        content = stream.decompress(compressed, limit + 1)
    except zlib.error as error:
        raise DataError(f"a compressed variable is damaged ({error})") from error
    if len(content) > limit:
        raise DataError(f"the variables take more than {_MAX_INFLATED} bytes when inflated")
    if not stream.eof:
        raise DataError("a compressed variable is cut off")
    return memoryview(content)
