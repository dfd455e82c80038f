"""Caffe for tests: a file written by the protobuf library, and the same layers run by numpy."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

LETTERS = "abcdefghijklmnopqrstuvwxyz"


@dataclass
class Spec:
    """One layer as a prototxt would have it."""

    name: str
    type: str
    bottoms: list[str]
    top: str
    blobs: list[np.ndarray] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)


# --- networks


def resnet(depths: tuple[int, int, int, int], *, numbered: bool, seed: int = 0) -> list[Spec]:
    """Return the bottleneck network of He et al. with random numbers.

    Numbered, its blocks are a b1 b2 ... as in ResNet-152; otherwise a b c ..., and the first convolution has a bias, as
    in ResNet-50, and an epsilon that is not the usual one stands in one normalisation.
    """
    rng = np.random.default_rng(seed)
    layers: list[Spec] = []

    def convolution(name: str, norm: str, bottom: str, shape: tuple[int, ...], **settings: int) -> None:
        weight = rng.standard_normal(shape, np.float32) * np.float32(math.sqrt(2 / math.prod(shape[1:])))
        blobs = [weight] + [rng.normal(size=shape[0]).astype(np.float32)] * (name == "conv1" and not numbered)
        layers.append(Spec(name, "Convolution", [bottom], name, blobs, settings))
        factor = rng.uniform(0.5, 900)
        mean, variance = rng.normal(0, 0.2, shape[0]), rng.uniform(0.5, 1.5, shape[0])
        blobs = [(mean * factor), (variance * factor), np.array([factor])]
        layers.append(Spec(f"bn{norm}", "BatchNorm", [name], name, [blob.astype(np.float32) for blob in blobs]))
        scale, shift = rng.uniform(0.3, 0.9, shape[0]), rng.normal(0, 0.2, shape[0])
        layers.append(Spec(f"scale{norm}", "Scale", [name], name, [scale.astype("f4"), shift.astype("f4")]))

    def rectify(name: str) -> None:
        layers.append(Spec(f"{name}_relu", "ReLU", [name], name))

    convolution("conv1", "_conv1", "data", (64, 3, 7, 7), pad=3, stride=2)
    rectify("conv1")
    layers.append(Spec("pool1", "Pooling", ["conv1"], "pool1", settings={"kernel_size": 3, "stride": 2}))
    bottom, wide = "pool1", 64
    for stage, depth in enumerate(depths, start=2):
        narrow = 32 * 2 ** (stage - 1)
        for block in range(depth):
            letter = f"b{block}" if numbered and block and stage in (3, 4) else LETTERS[block]
            norm, name = f"{stage}{letter}_branch", f"res{stage}{letter}"
            stride, short = (2 if block == 0 and stage > 2 else 1), bottom
            if block == 0:
                short = f"{name}_branch1"
                convolution(short, f"{norm}1", bottom, (4 * narrow, wide, 1, 1), stride=stride)
            branch = f"{name}_branch2"
            convolution(f"{branch}a", f"{norm}2a", bottom, (narrow, wide, 1, 1), stride=stride)
            rectify(f"{branch}a")
            convolution(f"{branch}b", f"{norm}2b", f"{branch}a", (narrow, narrow, 3, 3), pad=1)
            rectify(f"{branch}b")
            convolution(f"{branch}c", f"{norm}2c", f"{branch}b", (4 * narrow, narrow, 1, 1))
            layers.append(Spec(name, "Eltwise", [short, f"{branch}c"], name))
            rectify(name)
            bottom, wide = name, 4 * narrow
    next(layer for layer in layers if layer.name == "bn2a_branch2b").settings["eps"] = 1e-5 if numbered else 0.25
    classifier = rng.standard_normal((365, wide), np.float32)
    layers.append(Spec("fc365", "InnerProduct", [bottom], "fc365", [classifier, np.zeros(365, np.float32)]))
    return layers


def vgg16(seed: int = 0) -> list[Spec]:
    rng = np.random.default_rng(seed)
    layers, bottom, wide = [], "data", 3
    for block, (count, channels) in enumerate(((2, 64), (2, 128), (3, 256), (3, 512), (3, 512)), start=1):
        for part in range(1, count + 1):
            name = f"conv{block}_{part}"
            weight = rng.standard_normal((channels, wide, 3, 3), np.float32) * math.sqrt(2 / (9 * wide))
            shift = rng.normal(size=(1, 1, 1, channels))
            blobs = [weight.astype("f4"), shift.astype("f4")]
            layers += [Spec(name, "Convolution", [bottom], name, blobs, {"pad": 1})]
            layers += [Spec(f"relu{block}_{part}", "ReLU", [name], f"relu{block}_{part}")]
            bottom, wide = f"relu{block}_{part}", channels
        layers.append(Spec(f"pool{block}", "Pooling", [bottom], f"pool{block}", [], {"kernel_size": 2, "stride": 2}))
        bottom = f"pool{block}"
    return layers


# --- numpy


def convolve(x: np.ndarray, weight: np.ndarray, *, stride: int = 1, pad: int = 0) -> np.ndarray:
    """Return the convolution of x (c, h, w) with weight (out, c, side, side), as neural networks mean it."""
    side = weight.shape[2]
    x = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    windows = np.lib.stride_tricks.sliding_window_view(x, (side, side), (1, 2))[:, ::stride, ::stride]
    columns = windows.transpose(1, 2, 0, 3, 4).reshape(-1, weight[0].size)
    return (columns @ weight.reshape(len(weight), -1).T).T.reshape(len(weight), *windows.shape[1:3])


def pool(x: np.ndarray, *, kernel_size: int, stride: int, ceil: bool = True) -> np.ndarray:
    """Return the maxima; a last window that hangs over the edge counts where Caffe rounds sizes up."""
    sizes = [(side - kernel_size) / stride for side in x.shape[1:]]
    high, wide = (int(np.ceil(size) if ceil else np.floor(size)) + 1 for size in sizes)
    out = np.empty((len(x), high, wide), x.dtype)
    for row in range(high):
        for column in range(wide):
            top, left = row * stride, column * stride
            out[:, row, column] = x[:, top : top + kernel_size, left : left + kernel_size].max((1, 2))
    return out


def run(layers: list[Spec], data: np.ndarray) -> dict[str, np.ndarray]:
    """Compute every top from data (3, h, w), blue, green, red."""
    tops = {"data": data}
    for layer in layers:
        x = tops[layer.bottoms[0]]
        blobs = [blob.reshape(-1, 1, 1) if layer.type != "Convolution" else blob for blob in layer.blobs]
        if layer.type == "Convolution":
            y = convolve(x, blobs[0], **layer.settings)
            if len(blobs) > 1:
                y = y + blobs[1].reshape(-1, 1, 1)
        elif layer.type == "BatchNorm":
            mean, variance, factor = blobs
            y = (x - mean / factor) / np.sqrt(variance / factor + layer.settings.get("eps", 1e-5))
        elif layer.type == "Scale":
            y = x * blobs[0] + blobs[1]
        elif layer.type == "ReLU":
            y = np.maximum(x, 0)
        elif layer.type == "Pooling":
            y = pool(x, **layer.settings)
        elif layer.type == "Eltwise":
            y = x + tops[layer.bottoms[1]]
        else:
            continue
        tops[layer.top] = y
    return tops


# --- files

_TYPE = descriptor_pb2.FieldDescriptorProto
_SCHEMA = {
    "Shape": [(1, "dim", _TYPE.TYPE_INT64, "packed")],
    # Numbers as bytes: on the wire the same as packed floats, and quick to write. `Floats` has them as they are.
    "Blob": [(n, f"side{n}", _TYPE.TYPE_INT32, "") for n in (1, 2, 3, 4)]
    + [(5, "data", _TYPE.TYPE_BYTES, ""), (7, "shape", "Shape", ""), (8, "double_data", _TYPE.TYPE_BYTES, "")],
    "Floats": [(5, "data", _TYPE.TYPE_FLOAT, "packed"), (7, "shape", "Shape", "")],
    "Convolution": [
        (1, "num_output", _TYPE.TYPE_UINT32, ""),
        (3, "pad", _TYPE.TYPE_UINT32, "repeated"),
        (4, "kernel_size", _TYPE.TYPE_UINT32, "repeated"),
        (5, "group", _TYPE.TYPE_UINT32, ""),
        (6, "stride", _TYPE.TYPE_UINT32, "repeated"),
    ],
    "Pooling": [
        (1, "pool", _TYPE.TYPE_INT32, ""),
        (2, "kernel_size", _TYPE.TYPE_UINT32, ""),
        (3, "stride", _TYPE.TYPE_UINT32, ""),
        (4, "pad", _TYPE.TYPE_UINT32, ""),
    ],
    "BatchNorm": [(1, "use_global_stats", _TYPE.TYPE_BOOL, ""), (3, "eps", _TYPE.TYPE_FLOAT, "")],
    "Layer": [
        (1, "name", _TYPE.TYPE_STRING, ""),
        (2, "type", _TYPE.TYPE_STRING, ""),
        (3, "bottom", _TYPE.TYPE_STRING, "repeated"),
        (4, "top", _TYPE.TYPE_STRING, "repeated"),
        (7, "blobs", "Blob", "repeated"),
        (106, "convolution", "Convolution", ""),
        (121, "pooling", "Pooling", ""),
        (139, "batch_norm", "BatchNorm", ""),
    ],
    "OldLayer": [
        (2, "bottom", _TYPE.TYPE_STRING, "repeated"),
        (3, "top", _TYPE.TYPE_STRING, "repeated"),
        (4, "name", _TYPE.TYPE_STRING, ""),
        (5, "type", _TYPE.TYPE_INT32, ""),
        (6, "blobs", "Blob", "repeated"),
        (10, "convolution", "Convolution", ""),
        (19, "pooling", "Pooling", ""),
    ],
    "Net": [
        (1, "name", _TYPE.TYPE_STRING, ""),
        (2, "layers", "OldLayer", "repeated"),
        (3, "input", _TYPE.TYPE_STRING, "repeated"),
        (4, "input_dim", _TYPE.TYPE_INT32, "repeated"),
        (100, "layer", "Layer", "repeated"),
    ],
}
"""The part of caffe.proto that matters here: message -> number, name, type, label of its fields."""


@functools.cache
def message(name: str) -> Any:
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(f"caffe.{name}"))


@functools.cache
def _pool() -> descriptor_pool.DescriptorPool:
    file = descriptor_pb2.FileDescriptorProto(name="caffe.proto", package="caffe", syntax="proto2")
    for message_name, fields in _SCHEMA.items():
        described = file.message_type.add(name=message_name)
        for number, name, kind, label in fields:
            found = described.field.add(name=name, number=number, label=3 if label else 1)
            if isinstance(kind, str):
                found.type, found.type_name = _TYPE.TYPE_MESSAGE, f".caffe.{kind}"
            else:
                found.type = kind
            if label == "packed":
                found.options.packed = True
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return pool


def write(layers: list[Spec], path: Path, *, name: str = "ResNet-places365", old: bool = False) -> Path:
    """Write a caffemodel; `old` is the layer of before 2014, with four sides to each blob."""
    net = message("Net")(name=name, input=["data"], input_dim=[10, 3, 224, 224])
    for spec in layers:
        written = (net.layers if old else net.layer).add(name=spec.name, bottom=spec.bottoms, top=[spec.top])
        if not old:
            written.type = spec.type
        for blob in spec.blobs:
            _fill(written.blobs.add(), blob, old=old)
        _settle(written, spec)
    path.write_bytes(net.SerializeToString())
    return path


def _fill(blob: Any, array: np.ndarray, *, old: bool) -> None:
    setattr(blob, "double_data" if array.dtype == np.float64 else "data", array.tobytes())
    if old:
        for number, side in zip((1, 2, 3, 4), (1, 1, 1, 1, *array.shape)[-4:], strict=True):
            setattr(blob, f"side{number}", side)
    else:
        blob.shape.dim.extend(array.shape)


def _settle(written: Any, spec: Spec) -> None:
    if spec.type == "Convolution":
        written.convolution.num_output = len(spec.blobs[0])
        written.convolution.kernel_size.append(spec.blobs[0].shape[2])
        for key, value in spec.settings.items():
            getattr(written.convolution, key).append(value)
    elif spec.type == "Pooling":
        for key, value in spec.settings.items():
            setattr(written.pooling, key, value)
    elif spec.type == "BatchNorm":
        written.batch_norm.use_global_stats = True
        if "eps" in spec.settings:
            written.batch_norm.eps = spec.settings["eps"]


def relative_errors(found: dict[str, np.ndarray], wanted: dict[str, np.ndarray]) -> dict[str, float]:
    """Return, by tap, the largest difference as a share of the largest number."""
    return {
        layer: float(np.abs(maps - wanted[layer]).max() / np.abs(wanted[layer]).max()) for layer, maps in found.items()
    }
