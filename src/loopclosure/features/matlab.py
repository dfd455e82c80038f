"""Variables of MATLAB files, versions 5 to 7: arrays, text, and the cells and structures that hold them.

Nothing is executed, nothing is read outside the bytes of the file, and what is unpacked is bounded. Objects, function
handles and sparse or complex arrays become None. (MathWorks, MAT-File Format, level 5.)
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

MAX_BYTES = 2 << 30
"""Most bytes of an unpacked variable."""
MAX_DEPTH = 16
"""Of cells and structures inside each other."""

_HEADER_BYTES, _TAG_BYTES, _HEAD_BYTES = 128, 8, 4096
_MATRIX, _PACKED = 14, 15
_CELL, _STRUCT, _CHAR, _NUMBERS = 1, 2, 4, range(6, 16)
_COMPLEX = 0x08
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"} | {
    16: "u1",  # text in UTF-8
    17: "u2",
}


def read_variable(file: Path, name: str) -> Any:
    """Read one variable.

    Parameters
    ----------
    file : pathlib.Path
        ``.mat``.
    name : str
        Of the variable.

    Returns
    -------
    ndarray, str, list (cell) or dict (structure of one element), list of dict (of several), or None

    Raises
    ------
    ValueError, zlib.error, struct.error
        If the file is damaged, too large, of version 7.3, or has no such variable.
    """
    with file.open("rb") as stream:
        header = stream.read(_HEADER_BYTES)
        if header[:10] == b"MATLAB 7.3" or header.startswith(b"\x89HDF"):
            raise ValueError("it is of version 7.3; save it again with -v7")
        order = {b"IM": "<", b"MI": ">"}.get(header[-2:])
        if order is None or len(header) < _HEADER_BYTES:
            raise ValueError("it has no header of version 5, 6 or 7")
        while len(tag := stream.read(_TAG_BYTES)) == _TAG_BYTES:
            kind, size = struct.unpack(f"{order}II", tag)
            start = stream.tell()
            if kind in (_MATRIX, _PACKED):
                head = _unpacked(stream, kind, size, _HEAD_BYTES)
                if _Reader(head, order).head()[2] == name:
                    stream.seek(start)
                    return _value(_Reader(_unpacked(stream, kind, size, MAX_BYTES), order), depth=0)
            stream.seek(start + size)
    raise ValueError(f"it has no variable '{name}'")


def _unpacked(stream: BinaryIO, kind: int, size: int, most: int) -> memoryview:
    """Return at most `most` bytes of the matrix that begins at the position of the stream."""
    data = memoryview(stream.read(min(size, most)))
    if kind == _PACKED:
        data = memoryview(zlib.decompressobj().decompress(data, most + _TAG_BYTES))[_TAG_BYTES:]
    if len(data) == MAX_BYTES:
        raise ValueError(f"it holds more than {MAX_BYTES} bytes")
    return data


class _Reader:
    """Walks over the data elements inside one array."""

    def __init__(self, data: memoryview, order: str) -> None:
        self._data, self.order, self._at = data, order, 0

    def element(self) -> tuple[int, memoryview]:
        """Return type and bytes of the next element and step over its padding."""
        kind, size = struct.unpack_from(f"{self.order}II", self._data, self._at)
        start, end = self._at + 8, self._at + 8 + (size + 7) // 8 * 8
        if kind >> 16:  # four bytes or less share one word with their tag
            kind, size, start, end = kind & 0xFFFF, kind >> 16, self._at + 4, self._at + 8
        if start + size > len(self._data):
            raise ValueError("it ends early")
        self._at = end
        return kind, self._data[start : start + size]

    def numbers(self) -> np.ndarray:
        """Return the next element as numbers."""
        kind, data = self.element()
        if kind not in _STORED:
            raise ValueError(f"it holds an element of unknown type {kind}")
        return np.frombuffer(data, np.dtype(self.order + _STORED[kind]))

    def head(self) -> tuple[int, tuple[int, ...], str]:
        """Return class, shape and name of the array; class 0 where it cannot be read."""
        flags = int(self.numbers()[0])
        if flags & 0xFF not in (_CELL, _STRUCT, _CHAR, *_NUMBERS) or flags >> 8 & _COMPLEX:
            return 0, (), ""
        shape = tuple(int(side) for side in self.numbers())
        return flags & 0xFF, shape, self.numbers().tobytes().decode("ascii", "replace")

    def inner(self) -> _Reader:
        """Return a reader of the array that comes next."""
        kind, data = self.element()
        if kind != _MATRIX:
            raise ValueError(f"it holds an element of type {kind} in place of an array")
        return _Reader(data, self.order)

    @property
    def empty(self) -> bool:
        """Whether there is nothing to read."""
        return not len(self._data)


def _value(reader: _Reader, *, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise ValueError(f"its structures are more than {MAX_DEPTH} deep")
    if reader.empty:
        return None
    kind, shape, _ = reader.head()
    if kind == _CELL:
        return [_value(reader.inner(), depth=depth + 1) for _ in range(math.prod(shape))]
    if kind == _STRUCT:
        length = int(reader.numbers()[0])
        packed = reader.numbers().tobytes()
        names = [packed[at : at + length].rstrip(b"\0").decode("ascii") for at in range(0, len(packed), length)]
        if not names:
            return {}
        rows = [{name: _value(reader.inner(), depth=depth + 1) for name in names} for _ in range(math.prod(shape))]
        return rows[0] if len(rows) == 1 else rows
    if kind == _CHAR:
        return "".join(map(chr, reader.numbers()))
    return reader.numbers().reshape(shape, order="F") if kind else None
