"""Convolutional networks, tapped at named layers (paper 2.1).

The networks are torchvision's and that of efficientnet-lite-pytorch, not copies of them. Each is cut into a chain of
parts, one a tap, and the chain ends at the last tap that is asked for: what lies behind is neither kept nor computed.

==================  ==============================================================================================
backbone            taps
==================  ==============================================================================================
efficientnet-lite0  s4, s8, s16, s32: the last block of that stride
resnet*             conv1: the stem after its pooling; conv2 .. conv5: the four stages of residual blocks
vgg16, alexnet      conv1 .. conv5: the last convolution of each block, before its ReLU and pooling, as in NetVLAD
                    (Arandjelovic et al. 2016); each convolution of AlexNet counts as a block
googlenet           conv1, conv2: after the first and second pooling; conv3 .. conv5: inception 3b, 4e, 5b
==================  ==============================================================================================
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import torch
from torch import nn

from loopclosure.errors import ConfigError, WeightsError, did_you_mean
from loopclosure.features.checkpoints import load_strictly, read_checkpoint
from loopclosure.images.preprocess import Preprocessing
from loopclosure.weights import Progress, Weights, file_sha256, locate, weights_for

MIN_SIDE = 32
"""Smallest input, pixels: all networks divide it by 32."""

_CONV = ("conv1", "conv2", "conv3", "conv4", "conv5")


@dataclass(frozen=True)
class Architecture:
    """How one network is built and cut.

    Attributes
    ----------
    build : callable
        ``(height, width)`` in pixels to the whole network.
    cut : callable
        The network to one module a tap, in the order of computation.
    layers : tuple of str
        Names of the taps in the same order.
    heads : tuple of str
        Children that only classify; their weights are not wanted.
    variants : dict of str to callable
        What turns the network into one that is told by its weights alone, by the name of the variant.
    """

    build: Callable[[int, int], nn.Module]
    cut: Callable[[nn.Module], Sequence[nn.Module]]
    layers: tuple[str, ...]
    heads: tuple[str, ...]
    variants: dict[str, Callable[[nn.Module], None]] = field(default_factory=dict)

    def network(self, height: int, width: int, variant: str = "") -> nn.Module:
        """Build the whole network in one of its variants, in evaluation mode."""
        network = self.build(height, width).eval()
        if variant:
            if variant not in self.variants:
                raise WeightsError(f"the weights are for an unknown variant '{variant}' of the network")
            self.variants[variant](network)
        return network


def _torchvision(name: str, **options: bool) -> Callable[[int, int], nn.Module]:
    def build(_height: int, _width: int) -> nn.Module:
        from torchvision.models import get_model  # a second that the default backbone does not need

        return get_model(name, **options)

    return build


def _efficientnet_lite0(height: int, width: int) -> nn.Module:
    from efficientnet_lite_pytorch import EfficientNet

    # The size decides the padding, which follows TensorFlow's "same" rule.
    return EfficientNet.from_name("efficientnet-lite0", image_size=(height, width))


def _cut_efficientnet(net: nn.Module) -> Sequence[nn.Module]:
    stem = (net._conv_stem, net._bn0, net._swish)
    blocks = list(net._blocks)
    return [nn.Sequential(*part) for part in ((*stem, *blocks[:3]), blocks[3:5], blocks[5:11], blocks[11:])]


def _cut_resnet(net: nn.Module) -> Sequence[nn.Module]:
    return [nn.Sequential(net.conv1, net.bn1, net.relu, net.maxpool), net.layer1, net.layer2, net.layer3, net.layer4]


def _resnet_of_caffe(net: nn.Module) -> None:
    """Put the stride where He et al. have it, into the first convolution of a block, and pool as Caffe does."""
    net.maxpool = nn.MaxPool2d(3, stride=2, ceil_mode=True)
    for stage in (net.layer2, net.layer3, net.layer4):
        stage[0].conv1.stride, stage[0].conv2.stride = stage[0].conv2.stride, stage[0].conv1.stride


def _pools_of_caffe(net: nn.Module) -> None:
    """Round the size of pooled maps up."""
    for module in net.features:
        if isinstance(module, nn.MaxPool2d):
            module.ceil_mode = True


def _cut_googlenet(net: nn.Module) -> Sequence[nn.Module]:
    parts = (
        (net.conv1, net.maxpool1),
        (net.conv2, net.conv3, net.maxpool2),
        (net.inception3a, net.inception3b),
        (net.maxpool3, net.inception4a, net.inception4b, net.inception4c, net.inception4d, net.inception4e),
        (net.maxpool4, net.inception5a, net.inception5b),
    )
    return [nn.Sequential(*part) for part in parts]


def _cut_after(*convolutions: int) -> Callable[[nn.Module], Sequence[nn.Module]]:
    """Return the cut of a plain chain of layers behind the convolutions at these positions."""

    def cut(net: nn.Module) -> Sequence[nn.Module]:
        ends = [0, *(position + 1 for position in convolutions)]
        parts = [net.features[start:end] for start, end in pairwise(ends)]
        for part in parts[1:]:
            part[0] = nn.ReLU()  # the network's own works in place and would overwrite the tap before it
        return parts

    return cut


BACKBONES: dict[str, Architecture] = {
    "efficientnet-lite0": Architecture(_efficientnet_lite0, _cut_efficientnet, ("s4", "s8", "s16", "s32"), ("_fc",)),
    **{name: Architecture(_torchvision(name), _cut_resnet, _CONV, ("fc",)) for name in ("resnet18", "resnet34")},
    **{
        name: Architecture(_torchvision(name), _cut_resnet, _CONV, ("fc",), {"caffe": _resnet_of_caffe})
        for name in ("resnet50", "resnet101", "resnet152")
    },
    "vgg16": Architecture(
        _torchvision("vgg16"), _cut_after(2, 7, 14, 21, 28), _CONV, ("classifier",), {"caffe": _pools_of_caffe}
    ),
    "alexnet": Architecture(_torchvision("alexnet"), _cut_after(0, 3, 6, 8, 10), _CONV, ("classifier",)),
    "googlenet": Architecture(
        _torchvision("googlenet", init_weights=False), _cut_googlenet, _CONV, ("aux1", "aux2", "fc")
    ),
}
"""Every backbone by name."""


class TapChain(nn.Module):  # type: ignore[misc]
    """Parts of a network one after the other; returns what comes out of those that are tapped.

    Parameters
    ----------
    parts : dict of str to Module
        By the name of the tap behind each, in order; those behind the last tap are left out.
    layers : tuple of str
        Taps to return, in this order.
    """

    def __init__(self, parts: dict[str, nn.Module], layers: tuple[str, ...]) -> None:
        super().__init__()
        names = list(parts)
        last = max(names.index(layer) for layer in layers)
        self.parts = nn.ModuleDict({name: parts[name] for name in names[: last + 1]})
        self.layers = layers

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Map a float32 (n, 3, height, width) tensor to one (n, c, h, w) tensor a tap."""
        taps = {}
        for name, part in self.parts.items():
            x = part(x)
            if name in self.layers:
                taps[name] = x
        return tuple(taps[layer] for layer in self.layers)


class Backbone:
    """A network that turns images into feature maps.

    Parameters
    ----------
    name : str
        One of `BACKBONES`.
    layers : str or tuple of str
        Taps.
    weights : str or path
        ``"default"``, a name of `loopclosure.weights.WEIGHTS`, a file, or ``"random"`` (never chosen by itself).
    height, width : int
        Size of the network's input, pixels.
    device : str
        Where it runs.
    progress : callable, optional
        Told ``(arrived, in_all)`` bytes while weights are downloaded.

    Attributes
    ----------
    shapes : dict of str to tuple of 3 int
        (h, w, c) of each tap's map.
    channels : dict of str to int
        c of each tap's map.
    module : TapChain
        The network itself, in evaluation mode: (n, 3, height, width) tensor to a tuple of (n, c, h, w) tensors.
    preprocessing : Preprocessing
        Images to the input of `module`.
    weights : Weights
        The record of the weights.
    weights_name : str
        Its name; ``"random (seed 0)"`` for random weights.
    weights_sha256 : str or None
        Of the file that was loaded; None for random weights.
    random : bool
        Whether the weights are random.

    Raises
    ------
    ConfigError
        If the backbone, a layer, the size or the device cannot be used.
    WeightsError
        If the weights are not to be had or do not fit.

    Examples
    --------
    >>> backbone = Backbone("efficientnet-lite0", "s16")
    >>> backbone.maps([np.zeros((480, 640, 3), np.uint8)])["s16"].shape
    (1, 14, 14, 112)
    """

    def __init__(
        self,
        name: str,
        layers: str | tuple[str, ...],
        *,
        weights: str = "default",
        height: int = 224,
        width: int = 224,
        device: str = "cpu",
        progress: Progress | None = None,
    ) -> None:
        self.name = name
        self.layers = (layers,) if isinstance(layers, str) else tuple(layers)
        architecture = _checked(name, self.layers)
        if min(height, width) < MIN_SIDE:
            raise ConfigError(f"the input is {width}x{height} pixels, wanted at least {MIN_SIDE}x{MIN_SIDE}")
        self.device = _usable(device)
        self.weights = weights_for(name, weights)
        self.preprocessing = Preprocessing(height, width, self.weights.mean, self.weights.std)
        with torch.device("meta"):  # shapes without numbers: no time, no memory, no random state
            network = architecture.network(height, width, self.weights.variant)
            chain = TapChain(dict(zip(architecture.layers, architecture.cut(network), strict=True)), self.layers).eval()
            taps = chain(torch.empty(1, 3, height, width))
        self.shapes = {layer: (*tap.shape[2:], tap.shape[1]) for layer, tap in zip(self.layers, taps, strict=True)}
        self.weights_sha256 = None
        if self.random:
            _draw(chain)
        else:
            self.weights_sha256 = _load(network, self.weights, architecture.heads, progress)
        # Channels last: 5 to 30 % faster on a CPU, and maps come out as they are wanted.
        self.module = chain.to(self.device, memory_format=torch.channels_last)

    @property
    def channels(self) -> dict[str, int]:
        """Number of channels of each tap."""
        return {layer: shape[2] for layer, shape in self.shapes.items()}

    @property
    def random(self) -> bool:
        """Whether the weights are random."""
        return self.weights.random

    @property
    def weights_name(self) -> str:
        """Name of the weights."""
        return self.weights.name

    def maps(self, images: Sequence[npt.NDArray[np.uint8]]) -> dict[str, npt.NDArray[np.float32]]:
        """Compute the feature maps of several images in one batch.

        Parameters
        ----------
        images : sequence of n uint8 (h, w, 3)
            RGB, any size; may be empty.

        Returns
        -------
        dict of str to float32 (n, h, w, c)
            One contiguous array a tap.
        """
        if not len(images):
            return {layer: np.empty((0, *shape), np.float32) for layer, shape in self.shapes.items()}
        return self.compute(self.preprocessing.batch(images))

    def compute(self, batch: npt.NDArray[np.float32]) -> dict[str, npt.NDArray[np.float32]]:
        """Compute the maps of a batch that `preprocessing` made, float32 (n, 3, height, width)."""
        with torch.inference_mode():
            taps = self.module(torch.from_numpy(batch).to(self.device, memory_format=torch.channels_last))
        arrays = (np.ascontiguousarray(tap.permute(0, 2, 3, 1).cpu().numpy()) for tap in taps)
        return dict(zip(self.layers, arrays, strict=True))


def _checked(name: str, layers: tuple[str, ...]) -> Architecture:
    if name not in BACKBONES:
        raise ConfigError(f"unknown backbone '{name}'{did_you_mean(name, BACKBONES)}; known: {', '.join(BACKBONES)}")
    known = BACKBONES[name].layers
    if not layers:
        raise ConfigError(f"no layer of {name} was named; known: {', '.join(known)}")
    for layer in layers:
        if layer not in known:
            raise ConfigError(
                f"{name} has no layer '{layer}'{did_you_mean(layer, known)}; its layers: {', '.join(known)}"
            )
    return BACKBONES[name]


def _usable(device: str) -> torch.device:
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError) as error:  # torch built without CUDA asserts
        raise ConfigError(f"the device '{device}' cannot be used: {str(error).splitlines()[0]}") from None


def _load(network: nn.Module, weights: Weights, heads: tuple[str, ...], progress: Progress | None) -> str:
    path = locate(weights, progress=progress)
    load_strictly(network, read_checkpoint(path), heads=heads, origin=f"{path} does not fit {weights.backbone}")
    return file_sha256(path)


def _draw(chain: nn.Module, seed: int = 0) -> None:
    """Fill convolutions with normal numbers of variance 1 / fan-in, which neither fade nor explode through any net."""
    generator = torch.Generator().manual_seed(seed)
    chain.to_empty(device="cpu")
    with torch.no_grad():
        for module in chain.modules():
            if isinstance(module, nn.Conv2d):
                module.weight.normal_(0, 1 / math.sqrt(module.weight[0].numel()), generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
            elif isinstance(module, nn.BatchNorm2d):
                module.reset_parameters()
