"""Matrices of MATLAB files, versions 5 to 7.

A reader of our own, because `scipy.io.loadmat` crashes the interpreter on some damaged files. Nothing here reads
outside the bytes it was given or unpacks more than a matrix can be. (MathWorks, MAT-File Format, level 5.)
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from loopclosure.evaluation.limits import MAX_BYTES

_FILE_HEADER_BYTES, _TAG_BYTES = 128, 8
_HEAD_BYTES = 4096
_MATRIX, _COMPRESSED = 14, 15
_SPARSE = 5
_CLASSES = {_SPARSE: 1, 6: 8, 7: 4, 8: 1, 9: 1, 10: 2, 11: 2, 12: 4, 13: 4, 14: 8, 15: 8}  # class -> bytes of a cell
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_COMPLEX_FLAG = 0x08


class Entry(NamedTuple):
    """One array of numbers in the file: what its head says, and where it lies."""

    name: str
    shape: tuple[int, ...]
    cell_bytes: int
    order: str
    packed: bool
    start: int
    size: int


def entries(file: Path) -> list[Entry]:
    """List the arrays of real numbers in the file without reading their cells.

    Raises
    ------
    ValueError, zlib.error, struct.error
        If the file is damaged.
    """
    found = []
    with file.open("rb") as stream:
        mark = stream.read(_FILE_HEADER_BYTES)[-2:]
        if mark not in (b"IM", b"MI"):
            raise ValueError("it has no header of version 5, 6 or 7")
        order = "<" if mark == b"IM" else ">"
        while len(tag := stream.read(_TAG_BYTES)) == _TAG_BYTES:
            kind, size = struct.unpack(f"{order}II", tag)
            start = stream.tell()
            if kind in (_MATRIX, _COMPRESSED):
                place = Entry("", (), 0, order, kind == _COMPRESSED, start, size)
                found += _head(place, _bytes(stream, place, _HEAD_BYTES))
            stream.seek(start + size)
    return found


def nonzero_cells(file: Path, entry: Entry) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and values of the cells of `entry` that are not 0."""
    with file.open("rb") as stream:
        stream.seek(entry.start)
        reader = _Reader(_bytes(stream, entry, MAX_BYTES + _HEAD_BYTES), entry.order)
    flags = int(reader.array()[0])
    reader.array(), reader.array()
    rows, columns = entry.shape
    if flags & 0xFF != _SPARSE:
        matrix = reader.array().reshape(columns, rows).T
        where = np.nonzero(matrix)
        return where[0], where[1], matrix[where]
    row, starts, value = reader.array(), reader.array(), reader.array()
    starts = starts.astype(np.int64)
    if len(starts) != columns + 1 or starts[0] != 0 or (np.diff(starts) < 0).any() or starts[-1] > len(row):
        raise ValueError("the columns of its sparse matrix are damaged")
    row, value = row[: starts[-1]], value[: starts[-1]]
    if len(value) != len(row) or (len(row) and not 0 <= row.min() <= row.max() < rows):
        raise ValueError("the rows of its sparse matrix are damaged")
    column = np.repeat(np.arange(columns), np.diff(starts))
    kept = value != 0
    return row[kept], column[kept], value[kept]


class _Reader:
    """Walks over the data elements inside one array."""

    def __init__(self, data: bytes, order: str) -> None:
        self._data, self._order, self._at = data, order, 0

    def array(self) -> np.ndarray:
        """Return the next element and step over its padding."""
        kind, size = struct.unpack_from(f"{self._order}II", self._data, self._at)
        start, end = self._at + 8, self._at + 8 + (size + 7) // 8 * 8
        if kind >> 16:  # four bytes or less share one word with their tag
            kind, size, start, end = kind & 0xFFFF, kind >> 16, self._at + 4, self._at + 8
        if kind not in _STORED or start + size > len(self._data):
            raise ValueError("it ends early or holds an element of unknown type")
        self._at = end
        dtype = np.dtype(self._order + _STORED[kind])
        return np.frombuffer(self._data, dtype, count=size // dtype.itemsize, offset=start)


def _bytes(stream: BinaryIO, entry: Entry, most: int) -> bytes:
    """Return at most `most` bytes of the array that begins at the position of the stream."""
    data = stream.read(min(entry.size, most))
    if not entry.packed:
        return data
    return zlib.decompressobj().decompress(data, most + _TAG_BYTES)[_TAG_BYTES:]


def _head(place: Entry, data: bytes) -> list[Entry]:
    """Return the entry at `place` as a list of one; of none if it is text, a structure or complex."""
    reader = _Reader(data, place.order)
    flags = int(reader.array()[0])
    if flags & 0xFF not in _CLASSES or flags >> 8 & _COMPLEX_FLAG:
        return []
    shape = tuple(int(side) for side in reader.array())
    name = reader.array().tobytes().decode("ascii")
    if not name.isidentifier():  # function handles leave an array without a name
        return []
    return [place._replace(name=name, shape=shape, cell_bytes=_CLASSES[flags & 0xFF])]
