"""Taps against torchvision's own feature extractor; loading against files that are good, odd, wrong and hostile."""

from __future__ import annotations

import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn
from torchvision.models import ResNet18_Weights, get_model, get_model_weights
from torchvision.models.feature_extraction import create_feature_extractor

from loopclosure.errors import ConfigError, ImageError, WeightsError
from loopclosure.features.backbones import BACKBONES, Backbone
from loopclosure.weights import DEFAULTS, WEIGHTS, file_sha256, locate

IMAGES = [np.random.default_rng(seed).integers(0, 256, (90, 120, 3), np.uint8) for seed in range(3)]
CONV = ("conv1", "conv2", "conv3", "conv4", "conv5")

NODES = {
    "resnet18": ("maxpool", "layer1", "layer2", "layer3", "layer4"),
    "vgg16": ("features.2", "features.7", "features.14", "features.21", "features.28"),
    "alexnet": ("features.0", "features.3", "features.6", "features.8", "features.10"),
    "googlenet": ("maxpool1", "maxpool2", "inception3b", "inception4e", "inception5b"),
}


def reference(name: str) -> nn.Module:
    """Return torchvision's network with random numbers everywhere, batch statistics too, and no classifier."""
    options = {"init_weights": False, "aux_logits": False, "transform_input": True} if name == "googlenet" else {}
    with torch.device("meta"):
        network = get_model(name, **options).eval()
    setattr(network, "classifier" if name in ("vgg16", "alexnet") else "fc", nn.Identity())
    network.to_empty(device="cpu")
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for tensor in network.state_dict().values():
            if tensor.ndim == 4:
                tensor.normal_(0, tensor[0].numel() ** -0.5, generator=generator)
            elif tensor.ndim == 1:
                tensor.uniform_(0.5, 1.5, generator=generator)
            else:
                tensor.zero_()
    for module in network.modules():
        if isinstance(module, nn.ReLU):
            module.inplace = False  # or the extractor would return taps that were overwritten
    return network


@pytest.fixture(scope="module")
def resnet18() -> dict[str, torch.Tensor]:
    return reference("resnet18").state_dict()


def normalised(name: str, height: int, width: int) -> torch.Tensor:
    """Return IMAGES as torchvision's networks are told to want them, resized as ours."""
    transform = get_model_weights(name).DEFAULT.transforms()
    planes = [cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR) / 255 for image in IMAGES]
    return torch.from_numpy(((np.stack(planes) - transform.mean) / transform.std).transpose(0, 3, 1, 2)).float()


@pytest.mark.parametrize("name", NODES)
def test_taps_are_torchvisions(name: str, tmp_path: Path) -> None:
    network = reference(name)
    torch.save(network.state_dict(), tmp_path / "own.pth")
    backbone = Backbone(name, CONV, weights=str(tmp_path / "own.pth"), height=96, width=128)
    assert not backbone.random
    assert backbone.weights_sha256 == file_sha256(tmp_path / "own.pth")
    extractor = create_feature_extractor(network, dict(zip(NODES[name], CONV, strict=True)))
    with torch.inference_mode():
        expected = extractor(normalised(name, 96, 128))
    maps = backbone.maps(IMAGES)
    assert list(maps) == list(CONV)
    for layer in CONV:
        wanted = expected[layer].permute(0, 2, 3, 1).numpy()
        scale = np.abs(wanted).max()
        assert scale > 1e-3
        assert maps[layer].dtype == np.float32
        assert maps[layer].flags.c_contiguous
        assert maps[layer].shape == wanted.shape == (3, *backbone.shapes[layer])
        np.testing.assert_allclose(maps[layer] / scale, wanted / scale, atol=2e-5)


@pytest.mark.parametrize(
    ("name", "sides", "channels"),
    [
        ("resnet18", (56, 56, 28, 14, 7), (64, 64, 128, 256, 512)),
        ("resnet34", (56, 56, 28, 14, 7), (64, 64, 128, 256, 512)),
        ("resnet50", (56, 56, 28, 14, 7), (64, 256, 512, 1024, 2048)),
        ("resnet101", (56, 56, 28, 14, 7), (64, 256, 512, 1024, 2048)),
        ("resnet152", (56, 56, 28, 14, 7), (64, 256, 512, 1024, 2048)),
        ("vgg16", (224, 112, 56, 28, 14), (64, 128, 256, 512, 512)),
        ("alexnet", (55, 27, 13, 13, 13), (64, 192, 384, 256, 256)),
        ("googlenet", (56, 28, 28, 14, 7), (64, 192, 480, 832, 1024)),
        ("efficientnet-lite0", (56, 28, 14, 7), (24, 40, 112, 320)),
    ],
)
def test_shapes_at_224(name: str, sides: tuple[int, ...], channels: tuple[int, ...]) -> None:
    layers = BACKBONES[name].layers
    backbone = Backbone(name, layers, weights="random")
    assert backbone.shapes == {
        layer: (side, side, count) for layer, side, count in zip(layers, sides, channels, strict=True)
    }
    assert backbone.channels == dict(zip(layers, channels, strict=True))
    for layer, array in backbone.maps(IMAGES[:1]).items():
        assert array.shape == (1, *backbone.shapes[layer])
        assert np.isfinite(array).all()
        assert 1e-3 < array.std() < 1e4  # random numbers neither fade nor explode on their way


@pytest.mark.parametrize(("name", "shape"), [("efficientnet-lite0", (4, 7, 320)), ("resnet18", (4, 7, 512))])
def test_odd_sizes(name: str, shape: tuple[int, ...]) -> None:
    layer = BACKBONES[name].layers[-1]
    backbone = Backbone(name, layer, weights="random", height=100, width=201)
    assert backbone.shapes[layer] == shape
    assert backbone.maps(IMAGES[:1])[layer].shape == (1, *shape)


def test_tables_agree() -> None:
    assert [*BACKBONES, "fasterrcnn_resnet50_fpn"] == list(DEFAULTS)  # regions have a module of their own
    for architecture in BACKBONES.values():
        with torch.device("meta"):
            network = architecture.build(224, 224)
        assert len(architecture.cut(network)) == len(architecture.layers)
        assert all(hasattr(network, head) for head in architecture.heads)


def test_layers_come_in_the_order_asked_and_none_behind_is_kept() -> None:
    backbone = Backbone("resnet18", ("conv3", "conv1"), weights="random")
    assert list(backbone.maps(IMAGES)) == ["conv3", "conv1"]
    assert list(backbone.module.parts) == ["conv1", "conv2", "conv3"]
    whole = get_model("resnet18")
    behind = sum(p.numel() for part in (whole.layer3, whole.layer4, whole.fc) for p in part.parameters())
    kept = sum(p.numel() for p in backbone.module.parameters())
    assert kept == sum(p.numel() for p in whole.parameters()) - behind


def test_module_gives_the_tensors_behind_the_maps() -> None:
    backbone = Backbone("efficientnet-lite0", ("s8", "s16"))
    assert not backbone.module.training
    taps = backbone.module(torch.from_numpy(backbone.preprocessing.batch(IMAGES)))
    assert all(tap.requires_grad for tap in taps)  # it can be trained
    maps = backbone.maps(IMAGES)
    for tap, layer in zip(taps, ("s8", "s16"), strict=True):
        np.testing.assert_allclose(tap.detach().permute(0, 2, 3, 1).numpy(), maps[layer], atol=1e-5)


# --- the embedded default


def package_network() -> nn.Module:
    from efficientnet_lite_pytorch import EfficientNet

    network = EfficientNet.from_name("efficientnet-lite0").eval()
    network.load_state_dict(torch.load(locate("efficientnet-lite0"), weights_only=True))
    return network


def classify(network: nn.Module, last: np.ndarray) -> torch.Tensor:
    """Return the logits of the package's head on our last maps."""
    with torch.inference_mode():
        x = torch.from_numpy(last).permute(0, 3, 1, 2)
        x = network._swish(network._bn1(network._conv_head(x)))
        return network._fc(network._avg_pooling(x).flatten(1))


def test_embedded_network_is_the_packages(capfd: pytest.CaptureFixture[str]) -> None:
    network = package_network()
    layers = BACKBONES["efficientnet-lite0"].layers
    backbone = Backbone("efficientnet-lite0", layers)
    assert (backbone.weights_name, backbone.random) == ("efficientnet-lite0", False)
    assert backbone.weights_sha256 == WEIGHTS["efficientnet-lite0"].sha256
    maps = backbone.maps(IMAGES)
    blocks: list[torch.Tensor] = []
    for block in network._blocks:
        block.register_forward_hook(lambda _module, _inputs, output: blocks.append(output))
    resized = np.stack([cv2.resize(image, (224, 224)) for image in IMAGES]).astype(np.float32)
    with torch.inference_mode():
        logits = network(torch.from_numpy((resized - 127) / 128).permute(0, 3, 1, 2))
    for layer in layers:
        last = [block for block in blocks if block.shape[2] == backbone.shapes[layer][0]][-1]
        np.testing.assert_allclose(maps[layer], last.permute(0, 2, 3, 1).numpy(), atol=1e-3)
    torch.testing.assert_close(classify(network, maps["s32"]), logits, atol=1e-3, rtol=1e-3)
    assert capfd.readouterr() == ("", "")


def test_embedded_network_knows_a_street(data_folder: Path) -> None:
    street = {"streetcar", "trolleybus", "traffic light", "cab", "passenger car", "parking meter", "garbage truck"}
    street |= {"limousine", "moving van", "minivan", "minibus", "tow truck", "street sign", "car mirror"}
    categories = ResNet18_Weights.DEFAULT.meta["categories"]
    files = sorted((data_folder / "street" / "images").glob("*"))[::12]
    maps = Backbone("efficientnet-lite0", "s32").maps([cv2.imread(str(file))[:, :, ::-1] for file in files])
    best = classify(package_network(), maps["s32"]).topk(3).indices.tolist()
    assert len(best) > 10
    assert np.mean([any(categories[index] in street for index in three) for three in best]) > 0.75


def test_a_batch_equals_its_images() -> None:
    backbone = Backbone("efficientnet-lite0", ("s16", "s32"))
    together = backbone.maps(IMAGES)
    for index, image in enumerate(IMAGES):
        for layer, array in backbone.maps([image]).items():
            np.testing.assert_allclose(array[0], together[layer][index], atol=1e-4)


def test_no_images_are_legal() -> None:
    maps = Backbone("efficientnet-lite0", ("s16", "s4")).maps([])
    assert {layer: (array.shape, array.dtype.name) for layer, array in maps.items()} == {
        "s16": ((0, 14, 14, 112), "float32"),
        "s4": ((0, 56, 56, 24), "float32"),
    }
    with pytest.raises(ImageError):
        Backbone("efficientnet-lite0", "s4").maps([np.zeros((8, 8), np.uint8)])


# --- random weights


def test_random_is_reproducible_and_leaves_torch_alone() -> None:
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    first = Backbone("resnet18", ("conv2", "conv3"), weights="random")
    assert torch.equal(torch.random.get_rng_state(), before)
    torch.manual_seed(2)
    second = Backbone("resnet18", "conv2", weights="random")
    assert (first.random, first.weights_name, first.weights_sha256) == (True, "random (seed 0)", None)
    # Also the same whatever the deepest tap is.
    np.testing.assert_array_equal(first.maps(IMAGES)["conv2"], second.maps(IMAGES)["conv2"])


def test_random_is_never_a_substitute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOOPCLOSURE_CACHE", str(tmp_path))
    for scheme in ("HTTPS_PROXY", "https_proxy"):
        monkeypatch.setenv(scheme, "http://127.0.0.1:9")  # nothing listens: as good as no network
    with pytest.raises(WeightsError, match=r"cannot download resnet18-f37072fd\.pth"):
        Backbone("resnet18", "conv1")


# --- files


def save(state: object, path: Path) -> str:
    torch.save(state, path)
    return str(path)


def conv2(weights: str) -> np.ndarray:
    return Backbone("resnet18", "conv2", weights=weights, height=64, width=64).maps(IMAGES)["conv2"]


def test_kinds_of_files_that_fit(resnet18: dict[str, torch.Tensor], tmp_path: Path) -> None:
    wanted = conv2(save(resnet18, tmp_path / "plain.pth"))
    save_file(resnet18, tmp_path / "tensors.safetensors")
    np.testing.assert_array_equal(conv2(str(tmp_path / "tensors.safetensors")), wanted)
    training = {"state_dict": {f"module.{key}": value for key, value in resnet18.items()}, "epoch": 3, "arch": "x"}
    np.testing.assert_array_equal(conv2(save(training, tmp_path / "places365.pth.tar")), wanted)
    old = {key: value for key, value in resnet18.items() if not key.endswith("num_batches_tracked")}
    np.testing.assert_array_equal(conv2(save(old, tmp_path / "old.pth")), wanted)
    head = {**resnet18, "fc.weight": torch.zeros(365, 512), "fc.bias": torch.full((365,), torch.nan)}
    np.testing.assert_array_equal(conv2(save(head, tmp_path / "head.pth")), wanted)
    double = {key: value.double() if value.is_floating_point() else value for key, value in resnet18.items()}
    np.testing.assert_array_equal(conv2(save(double, tmp_path / "double.pth")), wanted)
    torch.save(resnet18, tmp_path / "legacy.pth", _use_new_zipfile_serialization=False)
    np.testing.assert_array_equal(conv2(str(tmp_path / "legacy.pth")), wanted)


def test_data_parallel_inside_of_names(tmp_path: Path) -> None:
    # The AlexNet of Places-365 was trained with parallel features, which puts the prefix into the middle.
    state = {
        key.replace("features.", "features.module."): value for key, value in reference("alexnet").state_dict().items()
    }
    assert not Backbone("alexnet", "conv5", weights=save({"state_dict": state}, tmp_path / "a.pth.tar")).random


@pytest.mark.filterwarnings("ignore:Validating sparse")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bn1.weight": None}, "missing bn1.weight$"),
        ({"layer9.weight": torch.zeros(1)}, "unexpected layer9.weight$"),
        ({"layer4.1.bn2.bias": torch.zeros(3)}, "misshapen layer4.1.bn2.bias$"),
        ({"conv1.weight": torch.zeros(64, 3, 7, 7, dtype=torch.int64)}, "misshapen conv1.weight$"),
        ({"layer1.0.bn1.bias": torch.full((64,), torch.nan)}, "'layer1.0.bn1.bias' holds values that are not finite"),
        ({"conv1.weight": [1, 2]}, "'conv1.weight', which is no dense tensor"),
        ({"conv1.weight": torch.zeros(64, 3, 7, 7).to_sparse()}, "no dense tensor"),
    ],
)
def test_files_that_do_not_fit(
    resnet18: dict[str, torch.Tensor], tmp_path: Path, change: dict[str, object], message: str
) -> None:
    state = {key: value for key, value in {**resnet18, **change}.items() if value is not None}
    with pytest.raises(WeightsError, match=message) as raised:
        conv2(save(state, tmp_path / "odd.pth"))
    assert "\n" not in str(raised.value)


def test_a_file_of_another_network(tmp_path: Path) -> None:
    path = save(reference("resnet50").state_dict(), tmp_path / "resnet50.pth")
    with pytest.raises(WeightsError, match=r"resnet50.pth does not fit resnet18: unexpected .* and \d+ more") as raised:
        conv2(path)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 500


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("content", [b"", b"<html>404</html>", b"PK\x03\x04" + bytes(200), bytes(1000), b"\x80\x02}q"])
def test_garbage_is_one_line(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"garbage{suffix}"
    path.write_bytes(content)
    with pytest.raises(WeightsError, match="garbage") as raised:
        conv2(str(path))
    assert "\n" not in str(raised.value)


def test_truncated_file(resnet18: dict[str, torch.Tensor], tmp_path: Path) -> None:
    path = Path(save(resnet18, tmp_path / "cut.pth"))
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(WeightsError, match="is damaged"):
        conv2(str(path))


class Hostile:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.marker,)


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("wrap", [lambda bad: bad, lambda bad: {"state_dict": {"conv1.weight": bad}}])
def test_hostile_files_are_not_executed(tmp_path: Path, wrap: object) -> None:
    marker = tmp_path / "marker"
    bad = wrap(Hostile(marker))  # type: ignore[operator]
    torch.save(bad, tmp_path / "zip.pth")
    torch.save(bad, tmp_path / "legacy.pth", _use_new_zipfile_serialization=False)
    (tmp_path / "bare.pth").write_bytes(pickle.dumps(bad))
    for name in ("zip.pth", "legacy.pth", "bare.pth"):
        with pytest.raises(WeightsError, match="more than tensors"):
            conv2(str(tmp_path / name))
    assert not marker.exists()
    pickle.loads(pickle.dumps(bad))  # noqa: S301 - the bait would have been taken
    assert marker.exists()


# --- settings


@pytest.mark.parametrize(
    ("name", "layers", "options", "message"),
    [
        ("resnet51", "conv5", {}, "unknown backbone 'resnet51', did you mean 'resnet50'"),
        ("resnet18", "conv6", {}, "no layer 'conv6', did you mean 'conv.'.*conv1, conv2, conv3, conv4, conv5"),
        ("efficientnet-lite0", "conv5", {}, "its layers: s4, s8, s16, s32"),
        ("resnet18", (), {}, "no layer of resnet18 was named"),
        ("resnet18", "conv5", {"height": 16}, "224x16 pixels, wanted at least 32x32"),
        ("resnet18", "conv5", {"device": "toaster"}, "device 'toaster' cannot be used"),
    ],
)
def test_wrong_settings(name: str, layers: str | tuple[str, ...], options: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as raised:
        Backbone(name, layers, weights="random", **options)  # type: ignore[arg-type]
    assert "\n" not in str(raised.value)


def test_wrong_weights() -> None:
    with pytest.raises(WeightsError, match="are for resnet50, the backbone is resnet18"):
        Backbone("resnet18", "conv5", weights="resnet50-places365")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees_with_the_cpu() -> None:
    there = Backbone("efficientnet-lite0", "s16", device="cuda").maps(IMAGES)["s16"]
    np.testing.assert_allclose(there, Backbone("efficientnet-lite0", "s16").maps(IMAGES)["s16"], atol=1e-2)
