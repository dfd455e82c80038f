"""The user's own network: the same numbers as plain numpy, and clear words for every wrong file."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from loopclosure import Config, LoopDetector
from loopclosure.errors import ConfigError, WeightsError
from loopclosure.features import onnx_network
from loopclosure.features.onnx_network import OnnxNetwork
from loopclosure.methods import build_method

pytest.importorskip("onnxruntime")


def convolve(image, kernel):
    """Map of one image by plain loops: (8, 8, 5) from pixels that need no resizing."""
    pixels = (image / 255 - 0.5) / 0.25
    found = np.zeros((8, 8, len(kernel)))
    for row in range(8):
        for column in range(8):
            patch = pixels[8 * row : 8 * row + 8, 8 * column : 8 * column + 8].transpose(2, 0, 1)
            found[row, column] = [(patch * one).sum() for one in kernel]
    return found


@pytest.mark.parametrize("layout", ["nchw", "nhwc"])
def test_maps_and_vectors_are_the_networks(write_network, tmp_path, lap, layout):
    path, kernel = write_network(tmp_path, maps=True, layout=layout, name="maps")
    maps = OnnxNetwork(path).maps(lap[:2])["output"]
    wanted = np.stack([convolve(image, kernel) for image in lap[:2]])
    np.testing.assert_allclose(maps, wanted, atol=1e-4)
    path, _ = write_network(tmp_path, layout=layout, name="vectors")
    vectors = OnnxNetwork(path).vectors(lap[:2])
    np.testing.assert_allclose(vectors, np.hstack([wanted.mean((1, 2)), wanted.max((1, 2))]), atol=1e-4)


def test_a_network_of_maps_stands_in_front_of_kl_and_netvlad(write_network, tmp_path, lap):
    path, _ = write_network(tmp_path, maps=True)
    config = Config().with_settings(
        {"features.backbone": "onnx", "onnx.path": str(path), "sequence.length": 3, "aggregation.clusters": 8}
    )
    detector = LoopDetector(config)
    detector.set_reference(lap)
    assert detector.method.provenance["weights"] == "net.onnx"
    assert [decision.match for decision in detector.detect(lap)][2:] == list(range(2, 16))
    with pytest.raises(ConfigError, match="has only 'output'"):
        LoopDetector(config.with_settings({"features.layer": "conv5"}))


def test_a_network_of_another_kind_is_named(write_network, tmp_path, lap):
    path, _ = write_network(tmp_path, maps=True)
    method = build_method(Config().with_settings({"method": "onnx", "onnx.path": str(path)}))
    with pytest.raises(WeightsError, match="wants --method kl-netvlad --backbone onnx"):
        method.features(lap[:1])
    path, _ = write_network(tmp_path, name="vectors")
    with pytest.raises(WeightsError, match="a vector wants --method onnx"):
        OnnxNetwork(path).maps(lap[:1])


def test_numbers_that_are_not_finite_make_a_blank_frame(write_network, tmp_path, lap):
    path, _ = write_network(tmp_path, header={"std": [1e-38] * 3})
    assert not OnnxNetwork(path).vectors(lap[:1]).any()


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ({"heigth": 3}, "'heigth': extra inputs are not permitted, did you mean 'height'"),
        ({"mean": [0, 0]}, "'mean"),
        ({"height": 10**9}, "'height'"),
        ({"height": 32}, r"wanted one of tensor\(float\) that takes \[1, 3, 32, 64\]"),
        ({"output": "vectr"}, "has no output 'vectr', did you mean 'vector'"),
        ({"layout": "chw"}, "'layout'"),
        ({"std": [0, 1, 1]}, "std ="),
    ],
)
def test_wrong_headers(write_network, tmp_path, header, message):
    path, _ = write_network(tmp_path, header=header)
    with pytest.raises((WeightsError, ConfigError), match=message) as caught:
        OnnxNetwork(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[1]", "{", "[" * 30_000, '{"height": 1}' + " " * 70_000])
def test_damaged_headers(write_network, tmp_path, text):
    path, _ = write_network(tmp_path)
    path.with_suffix(".json").write_text(text)
    with pytest.raises(WeightsError) as caught:
        OnnxNetwork(path)
    assert "\n" not in str(caught.value)


def test_damaged_and_missing_networks(write_network, tmp_path, monkeypatch):
    path, _ = write_network(tmp_path)
    content = path.read_bytes()
    for damaged in (b"", b"not a network", content[: len(content) // 2]):
        path.write_bytes(damaged)
        with pytest.raises(WeightsError, match="is no ONNX network that can be run here"):
            OnnxNetwork(path)
    path.unlink()
    with pytest.raises(WeightsError, match=r"cannot read .*net\.onnx"):
        OnnxNetwork(path)
    with pytest.raises(ConfigError, match=r"set onnx\.path"):
        build_method(Config(method="onnx"))
    path.write_bytes(content)
    monkeypatch.setattr(onnx_network, "MAX_NETWORK_BYTES", 10)
    with pytest.raises(WeightsError, match="larger than 10 bytes"):
        OnnxNetwork(path)


@pytest.mark.parametrize("relative", [False, True])
def test_a_network_cannot_read_other_files(write_network, tmp_path, monkeypatch, relative):
    monkeypatch.chdir(tmp_path)
    onnx = pytest.importorskip("onnx")
    path, _ = write_network(tmp_path)
    model = onnx.load(path)
    (tmp_path / "secret").write_bytes(model.graph.initializer[0].raw_data)
    kernel = model.graph.initializer[0]
    kernel.ClearField("raw_data")
    kernel.data_location = onnx.TensorProto.EXTERNAL
    kernel.external_data.add(key="location", value="secret" if relative else str(tmp_path / "secret"))
    path.write_bytes(model.SerializeToString())
    with pytest.raises(WeightsError, match="is no ONNX network that can be run here"):
        OnnxNetwork(path)


def test_the_hash_tells_networks_apart(write_network, tmp_path, lap):
    path, _ = write_network(tmp_path)
    config = Config().with_settings({"method": "onnx", "onnx.path": str(path)})
    LoopDetector(config).fit(lap, source="lap")
    first = build_method(config).provenance
    write_network(tmp_path, maps=True)
    assert first["weights_sha256"] != build_method(config).provenance["weights_sha256"]


def test_the_missing_extra_is_named(write_network, tmp_path, monkeypatch):
    path, _ = write_network(tmp_path)
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ConfigError, match=r"pip install 'loopclosure\[onnx\]'"):
        OnnxNetwork(path)


def test_header_needs_no_more_than_a_size(write_network, tmp_path):
    path, _ = write_network(tmp_path)
    path.with_suffix(".json").write_text(json.dumps({"height": 64, "width": 64}))
    assert OnnxNetwork(path).header.mean == (0.485, 0.456, 0.406)
