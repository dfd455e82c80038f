"""From Caffe's layers to the tensors of torchvision's networks.

The stem and the blocks of a residual network are named as by He et al.: ``res4b35_branch2a`` with ``bn4b35_branch2a``
and ``scale4b35_branch2a``; the convolutions of VGG ``conv4_3``. What Caffe divides into a batch normalisation (mean,
variance, and a factor by which both were multiplied) and a scale (weight, bias) becomes the four vectors of one batch
normalisation. Caffe's networks see blue, green, red in 0..255; the first convolution is turned to red, green, blue.

Sources: `deploy_resnet152_places365.prototxt` of CSAILVision/places365; He et al. 2015, arXiv:1512.03385.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from loopclosure.features.caffemodel import CaffeNet, Layer, Window

_RESIDUAL = re.compile(r"(res|bn|scale)([2-5])([a-z])(\d*)_branch(1|2[abc])")
_VGG = re.compile(r"conv([1-5])_([1-3])")
_VGG16 = {1: (0, 2), 2: (5, 7), 3: (10, 12, 14), 4: (17, 19, 21), 5: (24, 26, 28)}
_STEM = {"conv1": "res", "bn_conv1": "bn", "scale_conv1": "scale"}
_EPSILON = 1e-5  # torch's

_MEANS = {"places": (116.060394287, 113.741088867, 105.487823486), "": (123.68, 116.779, 103.939)}
"""Mean red, green and blue of Places and of ImageNet, by what stands in the name of the network or the file."""


@dataclass(frozen=True)
class Translated:
    """A network in torchvision's terms.

    Attributes
    ----------
    tensors : dict of str to ndarray of float32
        By torchvision's names; a classifier's by Caffe's behind ``fc.`` or ``classifier.``.
    windows : dict of str to Window
        Of each convolution.
    pools : list of tuple of 3 int
        Side, stride and padding of each pooling by the maximum, in order.
    mean : tuple of 3 float
        Red, green and blue in 0..1.
    """

    tensors: dict[str, np.ndarray]
    windows: dict[str, Window]
    pools: list[tuple[int, int, int]]
    mean: tuple[float, float, float]


def translate(net: CaffeNet, *, file_name: str) -> Translated:
    """Return `net` in torchvision's terms.

    Parameters
    ----------
    net : CaffeNet
        A ResNet of 50 or more layers, or VGG16.
    file_name : str
        Tells the data that it was trained on where the network's own name does not.

    Raises
    ------
    ValueError
        If the layers are not those of such a network.
    """
    vgg = any(_VGG.fullmatch(layer.name) for layer in net.layers)
    tensors: dict[str, np.ndarray] = {}
    windows = {}
    for layer in net.layers:
        if not layer.blobs:
            continue
        if layer.name.startswith("fc"):
            tensors |= _named(f"{'classifier' if vgg else 'fc'}.{layer.name}", layer, ("weight", "bias"))
            continue
        kind, module = _vgg_place(layer.name) if vgg else _residual_place(layer.name)
        if kind == "bn":
            tensors |= _statistics(module, layer)
        else:
            tensors |= _named(module, layer, ("weight", "bias"))
        if layer.convolution is not None:
            windows[module] = layer.convolution
    if not vgg:
        _move_biases(tensors)
    first = "features.0.weight" if vgg else "conv1.weight"
    if first in tensors:
        tensors[first] = np.ascontiguousarray(tensors[first][:, ::-1])
    pools = [layer.pool for layer in net.layers if layer.pool is not None]
    return Translated(tensors, windows, pools, _mean(f"{net.name} {file_name}".lower()))


def _residual_place(name: str) -> tuple[str, str]:
    """Return what a layer is and the name of torchvision's convolution or normalisation."""
    if name in _STEM:
        return _STEM[name], "conv1" if name == "conv1" else "bn1"
    found = _RESIDUAL.fullmatch(name)
    if found is None:
        raise ValueError(f"its layer '{name}' belongs neither to a ResNet nor to VGG16")
    kind, stage, letter, number, branch = found.groups()
    block = int(number) if number else ord(letter) - ord("a")  # a b c ..., or a b1 b2 ...
    if branch == "1":
        part = f"downsample.{0 if kind == 'res' else 1}"
    else:
        part = f"{'conv' if kind == 'res' else 'bn'}{'abc'.index(branch[1]) + 1}"
    return kind, f"layer{int(stage) - 1}.{block}.{part}"


def _vgg_place(name: str) -> tuple[str, str]:
    found = _VGG.fullmatch(name)
    places = _VGG16[int(found[1])] if found else ()
    if found is None or int(found[2]) > len(places):
        raise ValueError(f"its layer '{name}' does not belong to VGG16")
    return "conv", f"features.{places[int(found[2]) - 1]}"


def _named(module: str, layer: Layer, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    if len(layer.blobs) > len(names):
        raise ValueError(f"its layer '{layer.name}' has {len(layer.blobs)} blobs, wanted at most {len(names)}")
    named = zip(names, layer.blobs, strict=False)
    return {f"{module}.{name}": _flat_bias(name, blob.astype(np.float32)) for name, blob in named}


def _flat_bias(name: str, blob: np.ndarray) -> np.ndarray:
    return blob.reshape(-1) if name == "bias" else blob  # older files have it as (1, 1, 1, n)


def _statistics(module: str, layer: Layer) -> dict[str, np.ndarray]:
    if len(layer.blobs) != 3 or layer.blobs[2].size != 1:
        raise ValueError(f"its layer '{layer.name}' does not hold mean, variance and their factor")
    mean, variance, factor = (blob.astype(np.float64).reshape(-1) for blob in layer.blobs)
    scale = 0 if factor[0] == 0 else 1 / factor[0]
    return {
        f"{module}.running_mean": (mean * scale).astype(np.float32),
        f"{module}.running_var": (variance * scale + (layer.epsilon - _EPSILON)).astype(np.float32),
    }


def _move_biases(tensors: dict[str, np.ndarray]) -> None:
    """Take the bias of a convolution, which torchvision's have not, out of the mean that is subtracted behind it."""
    for name in [name for name in tensors if re.search(r"(conv\d|downsample\.0)\.bias$", name)]:
        module = name.removesuffix(".bias").replace("downsample.0", "downsample.1").replace("conv", "bn")
        mean, bias = tensors.get(f"{module}.running_mean"), tensors.pop(name)
        if mean is None or mean.shape != bias.shape:
            raise ValueError(f"it has no batch normalisation behind {name}")
        tensors[f"{module}.running_mean"] = mean - bias


def _mean(names: str) -> tuple[float, float, float]:
    red, green, blue = next(mean for key, mean in _MEANS.items() if key in names)
    return red / 255, green / 255, blue / 255
