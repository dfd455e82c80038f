"""Read what Caffe wrote: layers with their numbers, from the protobuf wire format and without Caffe.

Of the schema (``caffe.proto`` of BVLC) only the fields that say what a network computes are looked at, in both its
versions of a layer. (Protocol Buffers, Encoding.)
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

MAX_FIELDS = 100_000
"""Most fields of one message."""

_VARINT, _EIGHT_BYTES, _BYTES, _FOUR_BYTES = 0, 1, 2, 5
_FIXED = {_EIGHT_BYTES: 8, _FOUR_BYTES: 4}


class Window(NamedTuple):
    """How a convolution or a pooling moves over its input."""

    stride: int
    pad: int
    dilation: int = 1
    groups: int = 1


@dataclass(frozen=True)
class Layer:
    """One layer.

    Attributes
    ----------
    name : str
        As its author chose it.
    blobs : list of ndarray of float32 or float64
        Weights, bias and so on, in Caffe's order.
    convolution : Window or None
        If it is a convolution.
    pool : tuple of int or None
        Side, stride and padding, if it pools by the maximum.
    epsilon : float
        Added to the variance by a batch normalisation.
    """

    name: str
    blobs: list[np.ndarray]
    convolution: Window | None
    pool: tuple[int, int, int] | None
    epsilon: float


@dataclass(frozen=True)
class CaffeNet:
    """A network.

    Attributes
    ----------
    name : str
        As its author chose it.
    layers : list of Layer
        In the order of computation.
    """

    name: str
    layers: list[Layer]


class _Numbers(NamedTuple):
    """Numbers of the fields of one version of a layer."""

    name: int
    blobs: int
    convolution: int
    pooling: int
    batch_norm: int


_LAYER = {100: _Numbers(1, 7, 106, 121, 139), 2: _Numbers(4, 6, 10, 19, -1)}
"""By the number that layers of this version have in a network: that of today, and ``V1LayerParameter``."""


def read_caffemodel(file: Path) -> CaffeNet:
    """Read a ``.caffemodel``.

    Raises
    ------
    ValueError
        If the file is cut short, or is none.
    """
    name, layers = "", []
    for number, value in _fields(memoryview(file.read_bytes())):
        if number == 1:
            name = _text(value)
        elif number in _LAYER:
            layers.append(_layer(_bytes(value), _LAYER[number]))
    if not any(layer.blobs for layer in layers):
        raise ValueError("it holds no layer with weights")
    return CaffeNet(name, layers)


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield number and value of each field of a message; a value is an integer or the bytes of it."""
    at = 0
    for _ in range(MAX_FIELDS):
        if at == len(data):
            return
        key, at = _varint(data, at)
        kind = key & 7
        if kind == _VARINT:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        if kind == _BYTES:
            size, at = _varint(data, at)
        elif kind in _FIXED:
            size = _FIXED[kind]
        else:
            raise ValueError(f"byte {at} begins no field")
        if size > len(data) - at:
            raise ValueError(f"it ends {size - len(data) + at} bytes early")
        yield key >> 3, data[at : at + size]
        at += size
    raise ValueError(f"a message has more than {MAX_FIELDS} fields")


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at == len(data):
            raise ValueError("it ends inside a number")
        value |= (data[at] & 0x7F) << shift
        at += 1
        if data[at - 1] < 0x80:
            return value, at
    raise ValueError("it holds a number of more than 64 bits")


def _bytes(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ValueError("a field has another type than Caffe's")  # noqa: TRY004 - the file is wrong, not the caller
    return value


def _text(value: int | memoryview) -> str:
    return bytes(_bytes(value)).decode("utf-8", "replace")


def _layer(data: memoryview, numbers: _Numbers) -> Layer:
    name, blobs, convolution, pool, epsilon = "", [], None, None, 1e-5
    for number, value in _fields(data):
        if number == numbers.name:
            name = _text(value)
        elif number == numbers.blobs:
            blobs.append(_blob(_bytes(value)))
        elif number == numbers.convolution:
            found = dict(_fields(_bytes(value)))
            convolution = Window(*(_integer(found, *field) for field in ((6, 1), (3, 0), (18, 1), (5, 1))))
        elif number == numbers.pooling:
            found = dict(_fields(_bytes(value)))
            if _integer(found, 1, 0) == 0:  # by the maximum
                pool = (_integer(found, 2, 0), _integer(found, 3, 1), _integer(found, 4, 0))
        elif number == numbers.batch_norm:
            for inner, stored in _fields(_bytes(value)):
                if inner == 3:
                    (epsilon,) = struct.unpack("<f", _bytes(stored))
    return Layer(name, blobs, convolution, pool, epsilon)


def _integer(found: dict[int, int | memoryview], number: int, default: int) -> int:
    value = found.get(number, default)
    return value if isinstance(value, int) else -1  # fits nothing


def _blob(data: memoryview) -> np.ndarray:
    """Return a ``BlobProto``: data (5) or double_data (8), shape (7) or the older num, channels, height, width."""
    parts, old, shape = [], {}, None
    for number, value in _fields(data):
        if number in (5, 8):
            parts.append(np.frombuffer(_bytes(value), "<f4" if number == 5 else "<f8"))
        elif number == 7:
            shape = _shape(_bytes(value))
        elif number <= 4 and isinstance(value, int):
            old[number] = value
    if shape is None:
        shape = [old.get(number, 0) for number in (1, 2, 3, 4)]
    numbers = np.concatenate(parts) if len(parts) > 1 else parts[0] if parts else np.empty(0, np.float32)
    if math.prod(shape) != len(numbers):
        raise ValueError(f"a blob of shape {shape} holds {len(numbers)} numbers")
    return numbers.reshape(shape)


def _shape(data: memoryview) -> list[int]:
    sides = []
    for number, value in _fields(data):
        if number != 1:
            continue
        if isinstance(value, int):
            sides.append(value)
        else:
            at = 0
            while at < len(value) and len(sides) < 8:
                side, at = _varint(value, at)
                sides.append(side)
    return sides
