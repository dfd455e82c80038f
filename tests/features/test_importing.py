"""Files of other programs against their own arithmetic in numpy, and files that must be refused."""

from __future__ import annotations

import json
import math
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import torch
from caffe_files import Spec, convolve, message, pool, relative_errors, resnet, run, vgg16, write
from safetensors.torch import save_file
from torchvision.models import get_model

from loopclosure.cli import main
from loopclosure.detect import LoopDetector
from loopclosure.errors import WeightsError
from loopclosure.features.backbones import Backbone
from loopclosure.features.caffemodel import read_caffemodel
from loopclosure.features.importing import import_weights
from loopclosure.features.matlab import read_variable
from loopclosure.weights import WEIGHTS, all_weights, file_sha256, is_cached, locate, weights_for

CONV = ("conv1", "conv2", "conv3", "conv4", "conv5")
PLACES_BGR = np.array([105.487823486, 113.741088867, 116.060394287])
IMAGE = np.random.default_rng(5).integers(0, 256, (64, 86, 3), np.uint8)


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "weights"


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["loopclosure", "weights", *map(str, arguments)])
        with pytest.raises(SystemExit) as stopped:
            main()
        captured = capsys.readouterr()
        return int(stopped.value.code or 0), captured.out, captured.err

    return call


def maps_of(name: str, backbone: str, image: np.ndarray = IMAGE) -> dict[str, np.ndarray]:
    network = Backbone(backbone, CONV, weights=name, height=image.shape[0], width=image.shape[1])
    return {layer: maps[0].transpose(2, 0, 1) for layer, maps in network.maps([image]).items()}


def blue_green_red(image: np.ndarray, mean: np.ndarray) -> np.ndarray:
    return (image[:, :, ::-1] - mean).transpose(2, 0, 1).astype(np.float32)


# --- Caffe, layer by layer


@pytest.fixture(scope="module")
def resnet50() -> list[Spec]:
    return resnet((3, 4, 6, 3), numbered=False)


def check_residual_network(layers: list[Spec], backbone: str, depths: tuple[int, ...], file: Path) -> None:
    imported = import_weights(write(layers, file), name="imported")
    assert (imported.weights.backbone, imported.weights.variant) == (backbone, "caffe")
    assert imported.taken["layer3"] == (3 * depths[2] + 1) * 5  # a convolution and four vectors
    assert imported.left_out == {"fc": 2}
    tops = run(layers, blue_green_red(IMAGE, PLACES_BGR))
    blocks = [top for top in tops if top.startswith("res") and "_" not in top]
    ends = [blocks[sum(depths[:stage]) - 1] for stage in (1, 2, 3, 4)]
    wanted = dict(zip(CONV, (tops[end] for end in ("pool1", *ends)), strict=True))
    errors = relative_errors(maps_of("imported", backbone), wanted)
    assert max(errors.values()) < 1e-4, errors


def test_caffe_resnet50(resnet50: list[Spec], tmp_path: Path, cache: Path) -> None:
    check_residual_network(resnet50, "resnet50", (3, 4, 6, 3), tmp_path / "resnet50_places365.caffemodel")
    ours = maps_of("imported", "resnet50")["conv5"]
    record = cache / "imported.json"
    record.write_text(record.read_text().replace('"caffe"', '""'))
    torchvisions = maps_of("imported", "resnet50")["conv5"]
    assert np.abs(ours - torchvisions).max() > 0.1 * np.abs(ours).max()  # the variant matters


@pytest.mark.slow
def test_caffe_resnet152(tmp_path: Path) -> None:
    layers = resnet((3, 8, 36, 3), numbered=True)
    check_residual_network(layers, "resnet152", (3, 8, 36, 3), tmp_path / "resnet152_places365.caffemodel")


def test_caffe_vgg16(tmp_path: Path) -> None:
    layers = vgg16()
    image = IMAGE[:45, :51]  # odd sizes, at which Caffe's pooling rounds up
    tops = run(layers, blue_green_red(image, np.array([103.939, 116.779, 123.68])))
    ends = ("conv1_2", "conv2_2", "conv3_3", "conv4_3", "conv5_3")
    wanted = dict(zip(CONV, (tops[end] for end in ends), strict=True))
    for old in (False, True):
        imported = import_weights(write(layers, tmp_path / "VGG_ILSVRC_16_layers.caffemodel", name="VGG", old=old))
        assert (imported.weights.name, imported.weights.backbone) == ("VGG-ILSVRC-16-layers", "vgg16")
        errors = relative_errors(maps_of("VGG-ILSVRC-16-layers", "vgg16", image), wanted)
        assert max(errors.values()) < 1e-4, errors


# --- Caffe, file by file


def test_numbers_as_protobuf_writes_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    single, double = rng.normal(size=(2, 3, 1, 1)).astype(np.float32), rng.normal(size=4)
    net = message("Net")(name="a net")
    layer = net.layer.add(name="first", type="Convolution")
    layer.convolution.pad.append(2)
    floats = message("Floats")(data=single.ravel().tolist())
    floats.shape.dim.extend(single.shape)
    layer.blobs.add().MergeFromString(floats.SerializeToString())
    blob = layer.blobs.add(double_data=double.tobytes())
    blob.shape.dim.append(4)
    net.layer.add(name="average").pooling.pool = 1
    (tmp_path / "x.caffemodel").write_bytes(net.SerializeToString())
    read = read_caffemodel(tmp_path / "x.caffemodel")
    assert (read.name, [found.name for found in read.layers]) == ("a net", ["first", "average"])
    np.testing.assert_array_equal(read.layers[0].blobs[0], single)
    np.testing.assert_array_equal(read.layers[0].blobs[1], double)
    assert read.layers[0].convolution == (1, 2, 1, 1)
    assert read.layers[0].pool is None
    assert read.layers[1].pool is None


def test_every_truncation_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "x.caffemodel"
    net = message("Net")()
    layer = net.layer.add(name="conv1")
    layer.convolution.pad.append(3)
    layer.blobs.add(data=bytes(12)).shape.dim.append(3)
    whole = net.SerializeToString()
    for end in range(len(whole)):
        file.write_bytes(whole[:end])
        with pytest.raises(ValueError, match=r"it ends|no layer with weights"):
            read_caffemodel(file)
    file.write_bytes(whole)
    assert read_caffemodel(file).layers[0].blobs[0].shape == (3,)


@pytest.mark.parametrize("seed", range(8))
def test_garbage_is_an_error(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    whole = bytearray(write(resnet((1, 0, 0, 0), numbered=False)[:4], tmp_path / "a.caffemodel").read_bytes())
    for place in rng.integers(0, len(whole), 200) if seed % 2 else rng.integers(0, 60, 8):
        whole[place] = rng.integers(0, 256)
    for suffix, content in ((".caffemodel", bytes(whole)), (".caffemodel", rng.bytes(500)), (".mat", rng.bytes(500))):
        (tmp_path / f"b{suffix}").write_bytes(content)
        with pytest.raises(WeightsError) as raised:
            import_weights(tmp_path / f"b{suffix}")
        assert "\n" not in str(raised.value)


def test_a_message_of_too_many_fields_ends(tmp_path: Path) -> None:
    (tmp_path / "x.caffemodel").write_bytes(b"\x18\x01" * 100_001)
    with pytest.raises(ValueError, match="more than 100000 fields"):
        read_caffemodel(tmp_path / "x.caffemodel")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"res3a_branch2a": {"stride": 1}}, r"moves layer2.0.conv1 with Window\(stride=1"),
        ({"conv1": {"pad": 0, "stride": 2}}, "moves conv1"),
        ({"pool1": {"kernel_size": 3, "stride": 2, "pad": 1}}, r"pools with \(\(3, 2, 1\),\)"),
    ],
)
def test_another_geometry_is_refused(
    resnet50: list[Spec], change: dict[str, dict[str, int]], message: str, tmp_path: Path
) -> None:
    layers = [replace(layer, settings=change.get(layer.name, layer.settings)) for layer in resnet50]
    with pytest.raises(WeightsError, match=message):
        import_weights(write(layers, tmp_path / "x.caffemodel"))


def test_unknown_caffe_networks_are_refused(tmp_path: Path) -> None:
    layers = resnet((1, 0, 0, 0), numbered=False)
    with pytest.raises(WeightsError, match="fits no network known here; the nearest is resnet50: missing layer"):
        import_weights(write(layers, tmp_path / "short.caffemodel"))
    layers[0].name = "conv1/7x7_s2"
    with pytest.raises(WeightsError, match="layer 'conv1/7x7_s2' belongs neither to a ResNet nor to VGG16"):
        import_weights(write(layers, tmp_path / "googlenet.caffemodel"))


# --- torch and safetensors


@pytest.fixture(scope="module")
def resnet18() -> dict[str, torch.Tensor]:
    torch.manual_seed(0)
    return get_model("resnet18").state_dict()


def test_torch_files(resnet18: dict[str, torch.Tensor], tmp_path: Path, cache: Path) -> None:
    torch.save(resnet18, tmp_path / "own.pth")
    places = {"state_dict": {f"module.{key}": value for key, value in resnet18.items()}, "arch": "resnet18"}
    torch.save(places, tmp_path / "mine_places365.pth.tar")
    save_file(resnet18, tmp_path / "tensors.safetensors")
    for file, name in (("own.pth", "own"), ("mine_places365.pth.tar", "mine-places365"), ("tensors.safetensors", None)):
        imported = import_weights(tmp_path / file, licence="CC BY")
        row = imported.weights
        assert row.name == (name or "tensors")
        assert (row.backbone, row.licence, row.source) == ("resnet18", "CC BY", file)
        assert imported.left_out == {"fc": 2}
        assert sum(imported.taken.values()) == len(resnet18) - 2
        assert imported.source_sha256 == file_sha256(tmp_path / file)
        assert row == weights_for("resnet18", row.name)
        assert is_cached(row.name)
        assert locate(row.name) == cache / f"{row.name}.safetensors"
        np.testing.assert_array_equal(
            maps_of(row.name, "resnet18")["conv5"], maps_of(str(tmp_path / "own.pth"), "resnet18")["conv5"]
        )
    assert [row.name for row in all_weights()][-3:] == ["mine-places365", "own", "tensors"]
    assert sorted(file.suffix for file in cache.iterdir()) == [".json"] * 3 + [".safetensors"] * 3


def test_a_file_of_the_table_takes_its_place(
    resnet18: dict[str, torch.Tensor], tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torch.save(resnet18, tmp_path / "resnet18.pth")
    listed = replace(WEIGHTS["resnet18-places365"], sha256=file_sha256(tmp_path / "resnet18.pth"), mean=(0.1, 0.2, 0.3))
    monkeypatch.setitem(WEIGHTS, "resnet18-places365", listed)
    assert import_weights(tmp_path / "resnet18.pth").weights is listed
    assert locate("resnet18-places365", download=False) == cache / "resnet18_places365.pth.tar"
    named = import_weights(tmp_path / "resnet18.pth", name="mine").weights
    assert (named.mean, named.licence) == ((0.1, 0.2, 0.3), "CC BY")


def test_the_embedded_file_can_be_imported_too() -> None:
    imported = import_weights(locate("efficientnet-lite0"), name="lite").weights
    assert (imported.backbone, imported.licence) == ("efficientnet-lite0", "Apache-2.0")
    assert imported.std == WEIGHTS["efficientnet-lite0"].std
    unnamed = import_weights(locate("efficientnet-lite0")).weights
    assert unnamed.path is not None
    assert unnamed.sha256 == imported.sha256


class Hostile:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.marker,)


def test_files_that_are_refused(resnet18: dict[str, torch.Tensor], tmp_path: Path, cache: Path) -> None:
    def refused(state: object, message: str, **options: str) -> None:
        torch.save(state, tmp_path / "own.pth")
        with pytest.raises(WeightsError, match=message) as raised:
            import_weights(tmp_path / "own.pth", **options)  # type: ignore[arg-type]
        assert "\n" not in str(raised.value)

    refused(Hostile(tmp_path / "marker"), "holds more than tensors")
    assert not (tmp_path / "marker").exists()
    cut = {key: value for key, value in resnet18.items() if key != "layer4.1.bn2.bias"}
    refused(cut, "fits no network known here; the nearest is resnet18: missing layer4.1.bn2.bias")
    refused(resnet18, "does not fit resnet50: missing .*; the nearest network is resnet18", backbone="resnet50")
    refused(resnet18, "unknown backbone 'resnet8', did you mean 'resnet18'", backbone="resnet8")
    refused(resnet18, "the name 'resnet18-places365' is taken", name="resnet18-places365")
    refused(resnet18, "the name 'default' is taken", name="default")
    refused(resnet18, "'../../etc/x' is no name", name="../../etc/x")
    refused({"a": torch.zeros(1)}, "none of the 1 tensors of .* fits a network known here")
    refused(resnet18 | {"conv1.weight": torch.full((64, 3, 7, 7), torch.nan)}, "not finite")
    (tmp_path / "own.pth").write_bytes((tmp_path / "own.pth").read_bytes()[:-1000])
    with pytest.raises(WeightsError, match="is damaged"):
        import_weights(tmp_path / "own.pth")
    for file, reason in ((tmp_path, "is not a file"), (tmp_path / "absent.pth", "No such file")):
        with pytest.raises(WeightsError, match=reason):
            import_weights(file)
    assert not cache.exists() or not list(cache.iterdir())


def test_foreign_files_ask_to_be_imported(tmp_path: Path) -> None:
    (tmp_path / "x.caffemodel").write_bytes(b"x")
    with pytest.raises(WeightsError, match=r"`loopclosure weights import .*x\.caffemodel` makes weights of it"):
        Backbone("resnet50", "conv5", weights=str(tmp_path / "x.caffemodel"))


# --- NetVLAD of MATLAB

CLUSTERS = 16


def netvlad_layers(seed: int = 3, *, depth: int = 512, whitening: int = 7) -> dict[str, Any]:
    """Return the structure ``net`` of a VGG16-NetVLAD as MATLAB lays it out."""
    rng = np.random.default_rng(seed)
    layers: list[dict[str, Any]] = []
    wide = 3
    for block, (count, channels) in enumerate(((2, 64), (2, 128), (3, 256), (3, 512), (3, 512)), start=1):
        for part in range(1, count + 1):
            weight = rng.standard_normal((3, 3, wide, channels), np.float32) * np.float32(math.sqrt(2 / (9 * wide)))
            bias = rng.standard_normal((1, channels), np.float32)
            layers.append({"type": "conv", "name": f"conv{block}_{part}", "weights": cell(weight, bias), "pad": 1.0})
            layers.append({"type": "relu", "name": f"relu{block}_{part}", "leak": 0.0})
            wide = channels
        layers.append({"type": "pool", "name": f"pool{block}", "method": "max", "stride": 2.0})
    layers = layers[:-2]  # no ReLU and no pooling behind conv5_3
    assignment = 8 * rng.standard_normal((1, 1, depth, CLUSTERS), np.float32)
    negated = rng.standard_normal((1, 1, depth, CLUSTERS), np.float32) / 20
    whiten = rng.standard_normal((1, 1, depth * CLUSTERS, whitening), np.float32)
    layers.append({"type": "normalize", "name": "preL2", "param": np.array([1024, 1e-12, 1, 0.5])})
    layers.append({"type": "custom", "name": "vlad:core", "weights": cell(assignment, negated), "K": float(CLUSTERS)})
    layers.append({"type": "custom", "name": "postL2", "weights": cell()})
    layers.append({"type": "conv", "name": "WPCA", "weights": cell(whiten, np.zeros((1, whitening), np.float32))})
    average = np.broadcast_to(np.array([123.0, 117.0, 104.0], np.float32), (4, 5, 3)).copy()
    return {"layers": cell(*layers), "meta": {"normalization": {"averageImage": average, "keepAspect": True}}}


def cell(*items: Any) -> np.ndarray:
    found = np.empty((1, len(items)), object)
    for place, item in enumerate(items):
        found[0, place] = item
    return found


def described(net: dict[str, Any], image: np.ndarray) -> np.ndarray:
    """Return the descriptor (K, D) that the published network makes of an image, by its own layers."""
    layers = net["layers"][0]
    x = (image - net["meta"]["normalization"]["averageImage"][0, 0]).transpose(2, 0, 1).astype(np.float32)
    for layer in layers[:29]:
        if layer["type"] == "conv":
            weight, bias = layer["weights"][0]
            x = convolve(x, weight.transpose(3, 2, 0, 1), pad=1) + bias.reshape(-1, 1, 1)
        elif layer["type"] == "relu":
            x = np.maximum(x, 0)
        else:
            x = pool(x, kernel_size=2, stride=2, ceil=False)
    local = x.reshape(len(x), -1).astype(float)
    local /= np.linalg.norm(local, axis=0)
    assignment, negated = (array[0, 0].astype(float) for array in layers[30]["weights"][0])
    shares = np.exp(assignment.T @ local)
    shares /= shares.sum(0)
    rows = [sum(shares[k, i] * (local[:, i] + negated[:, k]) for i in range(local.shape[1])) for k in range(CLUSTERS)]
    vlad = np.array([row / np.linalg.norm(row) for row in rows])
    return vlad / np.linalg.norm(vlad)


def test_published_netvlad(command: Any, tmp_path: Path) -> None:
    net, out = netvlad_layers(), tmp_path / "model"
    scipy.io.savemat(tmp_path / "Pitts30K_struct.mat", {"other": 1.0, "net": net}, do_compression=True)
    code, text, _ = command("import", tmp_path / "Pitts30K_struct.mat", "--out", out, "--json")
    found = json.loads(text)
    assert (code, found["weights"], found["backbone"]) == (0, "Pitts30K-struct", "vgg16")
    assert (found["taken"], found["model"]) == ({"features": 26}, str(out))
    detector = LoopDetector(model=out)
    assert (detector.config.method, detector.config.aggregation.clusters) == ("netvlad-vgg16", CLUSTERS)
    assert "its whitening to 7 numbers is not applied" in detector.learned_on[0]
    backbone = Backbone("vgg16", "conv5", weights="Pitts30K-struct", height=64, width=86)  # in single precision
    descriptor = detector.method.describe(list(backbone.maps([IMAGE])["conv5"])).reshape(CLUSTERS, 512)
    wanted = described(net, IMAGE)
    assert np.abs(descriptor - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_variables_of_matlab_files(tmp_path: Path) -> None:
    values = {
        "text": "a name",
        "cube": np.arange(24, dtype=np.int16).reshape(2, 3, 4),
        "nested": {"inner": {"x": np.float32(2.5)}, "list": cell("one", np.ones(3), cell())},
        "nothing": np.empty((0, 3)),
        "complex": np.array([1j]),
    }
    for packed in (True, False):
        scipy.io.savemat(tmp_path / "x.mat", values, do_compression=packed)
        assert read_variable(tmp_path / "x.mat", "text") == "a name"
        np.testing.assert_array_equal(read_variable(tmp_path / "x.mat", "cube"), values["cube"])
        nested = read_variable(tmp_path / "x.mat", "nested")
        assert nested["inner"]["x"] == 2.5
        assert (nested["list"][0], nested["list"][1].tolist(), nested["list"][2]) == ("one", [[1, 1, 1]], [])
        assert read_variable(tmp_path / "x.mat", "nothing").shape == (0, 3)
        with pytest.raises(ValueError, match="no variable 'net'"):
            read_variable(tmp_path / "x.mat", "net")


def test_damaged_matlab_files(tmp_path: Path) -> None:
    file = tmp_path / "x.mat"
    for packed in (True, False):
        scipy.io.savemat(file, {"net": {"layers": cell({"weights": cell(np.ones((3, 3)))})}}, do_compression=packed)
        whole = file.read_bytes()
        for end in range(0, len(whole), 7):
            file.write_bytes(whole[:end])
            with pytest.raises(WeightsError):
                import_weights(file)
        rng = np.random.default_rng(0)
        for _ in range(100):
            damaged = bytearray(whole)
            damaged[rng.integers(128, len(whole))] = rng.integers(0, 256)
            file.write_bytes(damaged)
            with pytest.raises(WeightsError):
                import_weights(file)
    file.write_bytes(b"MATLAB 7.3 MAT-file" + bytes(500))
    with pytest.raises(WeightsError, match=r"version 7\.3; save it again with -v7"):
        import_weights(file)
    deep: Any = 1.0
    for _ in range(30):
        deep = {"x": deep}
    scipy.io.savemat(file, {"net": deep})
    with pytest.raises(WeightsError, match="more than 16 deep"):
        import_weights(file)


def test_a_matlab_file_cannot_claim_a_length(tmp_path: Path) -> None:
    claimed = struct.pack("<II", 14, 1 << 31) + struct.pack("<IIII", 6, 8, 6, 0)
    (tmp_path / "x.mat").write_bytes(bytes(124) + b"\x00\x01IM" + claimed)
    with pytest.raises(WeightsError, match=r"x\.mat is damaged"):
        import_weights(tmp_path / "x.mat")


# --- the command line


def test_import_command(command: Any, resnet18: dict[str, torch.Tensor], tmp_path: Path, cache: Path) -> None:
    torch.save(resnet18, tmp_path / "own.pth")
    code, out, _ = command("import", tmp_path / "own.pth", "--licence", "MIT")
    assert code == 0
    assert "layer4" in out
    assert "left out (classifier)" in out
    assert "--backbone resnet18 --weights own" in out
    code, out, _ = command("import", tmp_path / "own.pth", "--name", "second", "--json")
    found = json.loads(out)
    assert (found["weights"], found["backbone"], found["left_out"]) == ("second", "resnet18", {"fc": 2})
    assert found["file"] == str(cache / "second.safetensors")
    listed = json.loads(command("--json")[1])
    assert listed["own"] == listed["own"] | {"here": "imported", "licence": "MIT", "source": "own.pth"}
    code, _, err = command("import", tmp_path / "own.pth", "--out", tmp_path / "model")
    assert (code, err.count("\n")) == (1, 1)
    assert "--out MODEL is for the clusters of a NetVLAD .mat" in err
