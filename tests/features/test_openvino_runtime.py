"""The compiled network against torch in single precision; what is kept on disk, damaged, missing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.features.backbones import Backbone
from loopclosure.features.networks import open_network
from loopclosure.features.openvino_runtime import LEAST_COSINE, OpenVinoBackbone, least_cosine
from loopclosure.images.decode import read_image
from loopclosure.methods import build_method

SMALL = {"weights": "random", "height": 64, "width": 96}
IMAGES = [
    cv2.resize(np.random.default_rng(seed).integers(0, 256, (12, 16, 3), np.uint8), (160, 120)) for seed in range(5)
]


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give the module one cache of its own."""
    folder = tmp_path_factory.getbasetemp() / "openvino-cache"
    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(folder))
    return folder


def kept(cache: Path) -> set[Path]:
    return set((cache / "networks").glob("*"))


def test_maps_are_those_of_torch_tap_by_tap() -> None:
    layers = ("conv2", "conv1")
    ours, torchs = OpenVinoBackbone("resnet18", layers, **SMALL), Backbone("resnet18", layers, **SMALL)
    assert ours.shapes == torchs.shapes
    assert (ours.weights_name, ours.weights_sha256) == (torchs.weights_name, None)
    found, wanted = ours.maps(IMAGES), torchs.maps(IMAGES)
    assert list(found) == list(layers)
    for layer in layers:
        assert found[layer].dtype == np.float32
        assert found[layer].flags.c_contiguous
        assert found[layer].shape == wanted[layer].shape
        assert least_cosine(found[layer], wanted[layer]) >= LEAST_COSINE


def test_a_batch_equals_its_images_and_results_are_not_overwritten() -> None:
    backbone = OpenVinoBackbone("resnet18", "conv2", **SMALL)
    together = backbone.maps(IMAGES)["conv2"]
    before = together.copy()
    alone = [backbone.maps([image])["conv2"][0] for image in IMAGES]
    np.testing.assert_array_equal(together, before)
    np.testing.assert_allclose(np.stack(alone), together, atol=1e-3 * np.abs(together).max())
    assert backbone.maps([])["conv2"].shape == (0, *backbone.shapes["conv2"])


def test_a_second_start_needs_no_torch(cache: Path) -> None:
    OpenVinoBackbone("resnet18", "conv2", **SMALL)
    code = (
        "import sys; from loopclosure.features.openvino_runtime import OpenVinoBackbone;"
        f"OpenVinoBackbone('resnet18', 'conv2', **{SMALL!r});"
        "assert not {'torch', 'openvino_telemetry'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert not [path for path in kept(cache) if path.suffix == ".part"]


def test_a_damaged_graph_is_made_anew(cache: Path) -> None:
    wanted = OpenVinoBackbone("resnet18", "conv1", **SMALL).maps(IMAGES)["conv1"]
    for folder in kept(cache):
        (folder / "network.xml").write_text("<net")
    np.testing.assert_array_equal(OpenVinoBackbone("resnet18", "conv1", **SMALL).maps(IMAGES)["conv1"], wanted)


def test_other_layers_sizes_and_weights_are_other_graphs(cache: Path, tmp_path: Path) -> None:
    OpenVinoBackbone("resnet18", "conv1", **SMALL)
    before = kept(cache)
    OpenVinoBackbone("resnet18", "conv1", **SMALL)
    assert kept(cache) == before
    OpenVinoBackbone("resnet18", "conv1", **{**SMALL, "width": 64})
    assert len(kept(cache)) == len(before) + 1


def test_no_place_to_keep_graphs_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path / "file" / "cache"))
    assert OpenVinoBackbone("resnet18", "conv1", **SMALL).maps(IMAGES[:1])["conv1"].any()
    assert "is not kept" in caplog.text


def test_least_cosine() -> None:
    rows = np.array([[1.0, 0.0], [0.0, 2.0]], np.float32)
    assert least_cosine(rows, 3 * rows) == pytest.approx(1)
    assert least_cosine(rows, rows[::-1]) == pytest.approx(0)
    assert least_cosine(np.array([[np.nan, 1.0]]), np.ones((1, 2))) == -1


def test_the_setting_chooses_the_runtime(monkeypatch: pytest.MonkeyPatch) -> None:
    config = Config().with_settings({f"features.{name}": value for name, value in SMALL.items()})
    assert isinstance(open_network(config), OpenVinoBackbone)
    assert isinstance(open_network(config.with_settings({"features.backend": "torch"})), Backbone)
    with pytest.raises(ConfigError, match="has no layer 'conv9'"):
        open_network(config.with_settings({"features.backbone": "resnet18", "features.layer": "conv9"}))
    monkeypatch.setitem(sys.modules, "openvino", None)
    assert isinstance(open_network(config), Backbone)
    with pytest.raises(ConfigError, match="pip install openvino"):
        open_network(config.with_settings({"features.backend": "openvino"}))


def test_descriptors_of_photographs(data_folder: Path) -> None:
    files = sorted((data_folder / "gardens_point" / "day_left").glob("*.jpg"))[:60:4]
    photographs = [read_image(file) for file in files]
    wanted = build_method(Config().with_settings({"features.backend": "torch"}))
    features = wanted.features(photographs)
    wanted.fit(features)
    ours = build_method(Config())
    ours.restore(wanted.to_arrays())
    found = np.stack([ours.describe([one]) for one in ours.features(photographs)])
    assert least_cosine(found, np.stack([wanted.describe([one]) for one in features])) >= LEAST_COSINE
