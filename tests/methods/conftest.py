"""Small drives and small networks that the tests make themselves."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest


def make_lap(frames, *, offset=0):
    """Views from a camera that moves sideways along a wall of coloured spots, `offset` pixels away from the track."""
    spots = np.random.default_rng(0).integers(0, 255, size=(10, 10 + 2 * frames, 3), dtype=np.uint8)
    wall = cv2.resize(spots, None, fx=8, fy=8, interpolation=cv2.INTER_LINEAR)
    return [wall[offset : offset + 64, 16 * i + offset : 16 * i + offset + 64] for i in range(frames)]


@pytest.fixture(scope="session")
def lap():
    return make_lap(16)


@pytest.fixture(scope="session")
def second_lap():
    return make_lap(16, offset=2)


@pytest.fixture(scope="session")
def write_network():
    """Function that writes a small network as ONNX."""
    return _write_network


def _write_network(folder, *, maps=False, layout="nchw", size=64, header=None, name="net"):
    """Write a network of one convolution (5 channels, 8 x 8 pixels) as ONNX; its map, or mean and maximum of it."""
    onnx = pytest.importorskip("onnx")
    helper, tensor = onnx.helper, onnx.TensorProto
    kernel = np.random.default_rng(1).normal(size=(5, 3, 8, 8)).astype(np.float32) / 14
    shape = [1, 3, size, size] if layout == "nchw" else [1, size, size, 3]
    nodes, entry = [], "image"
    if layout == "nhwc":
        nodes, entry = [helper.make_node("Transpose", ["image"], ["planes"], perm=[0, 3, 1, 2])], "planes"
    nodes.append(helper.make_node("Conv", [entry, "kernel"], ["map"], strides=[8, 8]))
    if maps and layout == "nhwc":
        nodes.append(helper.make_node("Transpose", ["map"], ["map_last"], perm=[0, 2, 3, 1]))
    elif not maps:
        nodes += [
            helper.make_node("GlobalAveragePool", ["map"], ["mean"]),
            helper.make_node("GlobalMaxPool", ["map"], ["most"]),
            helper.make_node("Concat", ["mean", "most"], ["both"], axis=1),
            helper.make_node("Flatten", ["both"], ["vector"]),
        ]
    output = nodes[-1].output[0]
    graph = helper.make_graph(
        nodes,
        "net",
        [helper.make_tensor_value_info("image", tensor.FLOAT, shape)],
        [helper.make_tensor_value_info(output, tensor.FLOAT, None)],
        [onnx.numpy_helper.from_array(kernel, "kernel")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path = folder / f"{name}.onnx"
    path.write_bytes(model.SerializeToString())
    values = {"height": size, "width": size, "mean": [0.5] * 3, "std": [0.25] * 3, "layout": layout, **(header or {})}
    path.with_suffix(".json").write_text(json.dumps(values))
    return path, kernel
