"""A bundle decides as the model that it was made from, where torch cannot be imported; damaged ones are refused."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from loopclosure import bundle, store
from loopclosure.bundle import export_model
from loopclosure.cli import app
from loopclosure.config import Config
from loopclosure.detect import LoopDetector
from loopclosure.errors import ConfigError, ModelError
from loopclosure.features.exported import ExportedNetwork
from loopclosure.features.onnx_network import OnnxNetwork
from loopclosure.features.openvino_runtime import import_openvino
from loopclosure.images.sequence import ImageSequence
from loopclosure.images.simulator import SimulationSettings, simulate
from loopclosure.training.card import save_model

CONFIG = Config().with_settings(
    {
        "features.height": 64,
        "features.width": 96,
        "aggregation.clusters": 8,
        "aggregation.components": 16,
        "sequence.length": 3,
        "sequence.exclude_recent": 10,
    }
)
FILES = (*store.EXPORTED_FILES, store.ARRAYS)
WITHOUT = """
import json, sys
for name in sys.argv[3].split(","):
    sys.modules[name] = None  # importing it is an error
from loopclosure import ImageSequence, LoopDetector
detector = LoopDetector(model=sys.argv[1])
decisions = detector.detect(ImageSequence(sys.argv[2]))
found = [[d.query, d.match, d.score, d.accepted, d.inliers, d.reason] for d in decisions]
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = SimulationSettings(frames=40, spacing_m=6.0, width=160, height=120)
    return simulate(tmp_path_factory.mktemp("bundle") / "drive", settings) / "images"


@pytest.fixture(scope="module")
def model(drive: Path) -> Path:
    detector = LoopDetector(CONFIG)
    detector.fit(ImageSequence(drive), source="drive")
    return detector.save_model(drive.parent.parent / "model")


@pytest.fixture(scope="module")
def exported(model: Path) -> Path:
    out = model.parent / "bundle"
    found = CliRunner().invoke(app, ["export", str(model), "--out", str(out), "--json"])
    assert found.exit_code == 0, found.output
    result = json.loads(found.stdout)
    assert result["bundle"] == str(out)
    assert set(result["cosines"]) == {"openvino", "onnx"}
    assert min(result["cosines"].values()) >= bundle.LEAST_COSINE
    return out


@pytest.fixture
def copy(exported: Path, tmp_path: Path) -> Path:
    return shutil.copytree(exported, tmp_path / "copy")


@pytest.mark.parametrize("absent", ["torch,torchvision,onnx,onnxruntime", "torch,torchvision,openvino"])
def test_decisions_where_torch_cannot_be_imported(exported: Path, model: Path, drive: Path, absent: str) -> None:
    command = [sys.executable, "-c", WITHOUT, str(exported), str(drive), absent]
    found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    wanted = list(LoopDetector(model=model).detect(ImageSequence(drive)))
    assert sum(decision.accepted for decision in wanted) > 3
    for (query, match, score, accepted, inliers, reason), want in zip(found, wanted, strict=True):
        assert (query, match, accepted, reason) == (want.query, want.match, want.accepted, want.reason)
        assert inliers == want.inliers
        assert (score is None) == (want.score is None)
        assert score is None or score == pytest.approx(want.score, abs=1e-3)


def test_what_is_in_it(exported: Path, model: Path) -> None:
    card = json.loads((exported / store.EXPORTED).read_text())
    for name in store.EXPORTED_FILES:
        assert card["sha256"][name] == hashlib.sha256((exported / name).read_bytes()).hexdigest()
    assert (card["backbone"], card["layer"]) == ("efficientnet-lite0", "s16")
    assert (exported / store.ARRAYS).read_bytes() == (model / store.ARRAYS).read_bytes()
    assert str(model.parent) not in (exported / store.HEADER).read_text()  # it can be moved
    onnx = pytest.importorskip("onnx")
    assert [entry.version for entry in onnx.load(exported / "network.onnx").opset_import] == [bundle.OPSET]


def test_both_forms_see_what_torch_sees(exported: Path) -> None:
    from loopclosure.features.backbones import Backbone

    images = list(np.random.default_rng(1).integers(0, 256, (3, 50, 70, 3), dtype=np.uint8))
    wanted = Backbone("efficientnet-lite0", "s16", height=64, width=96).maps(images)["s16"]
    for runtime in ("openvino", "onnx"):
        network = ExportedNetwork(exported / store.EXPORTED, runtime=runtime)
        np.testing.assert_allclose(network.maps(images)["s16"], wanted, atol=1e-3 * np.abs(wanted).max())
        assert len(network.maps([])["s16"]) == 0
    alone = OnnxNetwork(exported / "network.onnx").maps(images)[OnnxNetwork.layer]
    np.testing.assert_allclose(alone, wanted, atol=1e-3 * np.abs(wanted).max())


def test_a_saved_detector_carries_the_network(copy: Path, drive: Path, tmp_path: Path) -> None:
    image = ImageSequence(drive)[0]
    detector = LoopDetector(model=copy)
    wanted = detector.method.describe(detector.method.features([image]))
    detector.add(image)
    detector.save(tmp_path / "saved")
    detector.save_model(tmp_path / "model")
    shutil.rmtree(copy)
    for again in (LoopDetector.load(tmp_path / "saved"), LoopDetector(model=tmp_path / "model")):
        found = again.method.describe(again.method.features([image]))
        np.testing.assert_allclose(found, wanted, atol=1e-5)


@pytest.mark.parametrize("name", FILES)
def test_a_damaged_file_is_refused(copy: Path, name: str) -> None:
    content = bytearray((copy / name).read_bytes())
    content[len(content) // 2] ^= 1
    (copy / name).write_bytes(content)
    with pytest.raises(ModelError, match=f"{name}.* (damaged|export again)"):
        LoopDetector(model=copy)
    (copy / name).unlink()
    with pytest.raises(ModelError, match=name):
        LoopDetector(model=copy)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": 2}, "format = 2"),
        ({"sha256": {}}, "network.xml is not the file that was exported"),
        ({"code": "import os"}, "unknown setting 'code'"),
        ({"height": 1 << 30}, "height = "),
    ],
)
def test_a_hostile_card_is_refused(copy: Path, change: dict, message: str) -> None:
    card = json.loads((copy / store.EXPORTED).read_text()) | change
    (copy / store.EXPORTED).write_text(json.dumps(card))
    with pytest.raises(ModelError, match=message):
        LoopDetector(model=copy)
    (copy / store.EXPORTED).write_text(" " * (1 << 20))
    with pytest.raises(ModelError, match="larger than"):
        LoopDetector(model=copy)


def test_another_graph_is_refused_even_with_the_right_hash(copy: Path) -> None:
    ov = import_openvino()
    images = ov.opset13.parameter([-1, 3, 8, 8], ov.Type.f32)
    ov.save_model(ov.Model([ov.opset13.relu(images)], [images]), copy / "network.xml", compress_to_fp16=False)
    card = json.loads((copy / store.EXPORTED).read_text())
    card["sha256"] |= {name: store.file_sha256(copy / name) for name in ("network.xml", "network.bin")}
    (copy / store.EXPORTED).write_text(json.dumps(card))
    with pytest.raises(ModelError, match=r"maps \[\?,3,8,8\]"):
        LoopDetector(model=copy)


def test_what_does_not_agree_is_not_written(model: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "LEAST_COSINE", 1.5)
    with pytest.raises(
        ModelError, match=r"by openvino descriptors agree with torch to a cosine of 1\.0.*, wanted 1\.5"
    ):
        export_model(model, tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_network_alone_learns_from_the_drive(drive: Path, tmp_path: Path) -> None:
    save_model(tmp_path / "model", CONFIG.with_settings({"features.weights": "random"}))
    export_model(tmp_path / "model", tmp_path / "bundle")
    detector = LoopDetector(model=tmp_path / "bundle")
    assert detector.method.provenance == {"weights": "random (seed 0)", "weights_sha256": None}
    assert [item.reason for item in detector.detect(list(ImageSequence(drive))[:5])] == ["warming_up"] * 5


def test_what_cannot_be_done_is_said(exported: Path, drive: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="is a bundle already"):
        export_model(exported, tmp_path / "out")
    save_model(tmp_path / "model", Config(method="seqslam"))
    with pytest.raises(ConfigError, match="is of the method seqslam"):
        export_model(tmp_path / "model", tmp_path / "out")
    config = LoopDetector(model=exported).config
    with pytest.raises(ConfigError, match="holds no torch network"):
        LoopDetector(config.with_settings({"features.backend": "torch"}), model=exported)
    with pytest.raises(ConfigError, match=r"features\.layer = s16, wanted s8"):
        LoopDetector(config.with_settings({"features.layer": "s8"}))


def test_no_torch_and_no_bundle_is_said(model: Path, drive: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path))  # no converted network is kept there
    command = [sys.executable, "-c", WITHOUT, str(model), str(drive), "torch,torchvision"]
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode == 1
    assert "ConfigError: the network efficientnet-lite0 is read by torch, which is not installed" in found.stderr
