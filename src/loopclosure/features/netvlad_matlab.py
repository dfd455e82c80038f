"""Published VGG16-NetVLAD networks: MatConvNet's layers as structures of a MATLAB file.

Layers with weights, in order: the 13 convolutions of VGG16 (height, width, in, out), the clusters (1, 1, D, K: how
they are assigned, and the centres negated), and mostly a PCA-whitening, which is not read.

Sources: Arandjelovic et al., CVPR 2016 (`layerVLAD.m` of Relja/netvlad); the files that hloc names.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.features.matlab import read_variable

_CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)


@dataclass(frozen=True)
class PublishedNetVLAD:
    """What such a file holds.

    Attributes
    ----------
    tensors : dict of str to ndarray of float32
        The convolutions by torchvision's names.
    mean : tuple of 3 float
        Red, green and blue in 0..1.
    clusters : dict of str to ndarray of float32
        ``centres`` (K, D), ``weights`` (K, D) and ``bias`` (K,) of `loopclosure.aggregation.netvlad.NetVLAD`.
    whitened : int
        Length to which the file's own PCA-whitening would bring descriptors; 0 if there is none.
    """

    tensors: dict[str, np.ndarray]
    mean: tuple[float, float, float]
    clusters: dict[str, np.ndarray]
    whitened: int


def read_netvlad(file: Path) -> PublishedNetVLAD:
    """Read a ``.mat`` with the structure ``net``.

    Raises
    ------
    ValueError, KeyError, TypeError, IndexError, zlib.error, struct.error
        If the file is damaged or holds another network.
    """
    net = read_variable(file, "net")
    found = [layer["weights"] for layer in net["layers"] if isinstance(layer, dict) and layer.get("weights")]
    if len(found) not in (14, 15):
        raise ValueError(f"it has {len(found)} layers with weights, wanted the 13 of VGG16, clusters and a whitening")
    tensors = {}
    for place, (weight, bias) in zip(_CONVOLUTIONS, found[:13], strict=True):
        tensors[f"features.{place}.weight"] = _float32(weight).transpose(3, 2, 0, 1).copy()
        tensors[f"features.{place}.bias"] = _float32(bias).reshape(-1)
    assignment, negated = (_float32(array) for array in found[13])
    if assignment.ndim != 4 or assignment.shape != negated.shape or assignment.shape[:2] != (1, 1):
        raise ValueError(f"its clusters are {assignment.shape} and {negated.shape}, wanted (1, 1, D, K) twice")
    clusters = {
        "centres": -negated[0, 0].T.copy(),
        "weights": assignment[0, 0].T.copy(),
        "bias": np.zeros(assignment.shape[3], np.float32),
    }
    whitened = int(found[14][0].shape[-1]) if len(found) == 15 else 0
    return PublishedNetVLAD(tensors, _mean(net), clusters, whitened)


def _float32(array: Any) -> np.ndarray:
    if not isinstance(array, np.ndarray):
        raise TypeError("weights are no array of numbers")
    return array.astype(np.float32)


def _mean(net: dict[str, Any]) -> tuple[float, float, float]:
    pixel = _float32(net["meta"]["normalization"]["averageImage"]).reshape(-1, 3, order="F")[0]
    if not np.isfinite(pixel).all():
        raise ValueError("its mean is not finite")
    red, green, blue = (float(value) / 255 for value in pixel)
    return red, green, blue
