"""Which parts of an image its descriptor is made of, and which make it similar to another one.

Grad-CAM (Selvaraju et al., ICCV 2017) weights the channels of a layer by their gradient, averaged over positions. That
is right where positions are summed next. In NetVLAD the layer before the sum is the map of residuals
``a_k(y_i) (y_i - c_k)``, K * D channels, and there the heat is exactly what each position adds to the similarity.
At the tap of the backbone it is not: local vectors are scaled to length 1 behind it, so that the gradient at each
position is at right angles to the vector that it is multiplied with.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import nn
from torch.nn import functional

from loopclosure.aggregation.change import change
from loopclosure.aggregation.netvlad import NetVLAD, unit
from loopclosure.aggregation.netvlad_torch import NetVLADLayer
from loopclosure.compression import ChannelKL
from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.methods import Method
from loopclosure.store import part

METHODS = ("kl-netvlad", "netvlad-resnet152", "netvlad-vgg16")
READINGS = ("channel", "none")


def check_explainable(config: Config) -> None:
    """Refuse a method whose descriptor is not a sum over map positions.

    Raises
    ------
    ConfigError
    """
    if config.method not in METHODS:
        raise ConfigError(f"'{config.method}' has no heat maps: they show NetVLAD descriptors, of {', '.join(METHODS)}")
    if config.compression.reading not in READINGS:
        raise ConfigError(
            f"compression.reading = '{config.compression.reading}' has no heat maps: wanted {' or '.join(READINGS)}, "
            "where a descriptor is made of one image and each position adds to it"
        )


class View(NamedTuple):
    """An image as the method sees it.

    Attributes
    ----------
    image : ndarray of uint8, shape (H, W, 3)
        RGB.
    maps : ndarray of float32, shape (h, w, c)
        The tap of the backbone.
    weights : ndarray of float32, shape (h, w)
        What each position counts.
    residuals : ndarray of float32, shape (h, w, K, D)
        What each position adds to the descriptor; their sum is the descriptor before centring.
    clusters : ndarray of int64, shape (h, w)
        The cluster that takes most of each position.
    mean : ndarray of float32, shape (K * D,)
        What is taken out of the descriptor.
    descriptor : ndarray of float32, shape (K * D,)
        Centred, unit length.
    """

    image: np.ndarray
    maps: np.ndarray
    weights: np.ndarray
    residuals: np.ndarray
    clusters: np.ndarray
    mean: np.ndarray
    descriptor: np.ndarray


class Match(NamedTuple):
    """Two positions, one in each image, that are more alike than either is to any other: (row, column) and share."""

    left: tuple[int, int]
    right: tuple[int, int]
    share: float


class Residuals(NetVLADLayer):
    """NetVLAD before its sum over positions: (n, D, h, w) to (n, K * D, h, w).

    Attributes
    ----------
    weights_of_positions : Tensor
        What each position counts, (h, w) or one number.
    """

    weights_of_positions = torch.ones(())

    def forward(self, codes: torch.Tensor) -> torch.Tensor:
        """Return what each position adds to each cluster."""
        local = functional.normalize(codes, dim=1).permute(0, 2, 3, 1)
        residuals = self._assign(local)[..., None] * (local[..., None, :] - self.centres)
        return residuals.flatten(3).permute(0, 3, 1, 2) * self.weights_of_positions

    def clusters(self, codes: torch.Tensor) -> torch.Tensor:
        """Return the cluster that takes most of each position, (n, h, w)."""
        return self._assign(functional.normalize(codes, dim=1).permute(0, 2, 3, 1)).argmax(-1)

    def _assign(self, local: torch.Tensor) -> torch.Tensor:
        return torch.softmax(local @ self.weights.T + self.bias, dim=-1)


class DescriptorNetwork(nn.Module):  # type: ignore[misc]
    """The way from the tap to the descriptor: KL as a 1 x 1 convolution, residuals, NetVLAD's sum.

    Lengths that NetVLAD divides by count as constants in gradients, so that the descriptor is a plain sum over
    positions and the shares of all positions add up to the whole.

    Parameters
    ----------
    method : Method
        Fitted; see `check_explainable`.
    """

    def __init__(self, method: Method) -> None:
        super().__init__()
        check_explainable(method.config)
        arrays = method.to_arrays()
        netvlad = NetVLAD.from_arrays(part(arrays, "netvlad"))
        self.count = netvlad.clusters
        self.compress = _projection(method.config, part(arrays, "kl"))
        self.residuals = Residuals(netvlad)
        self.requires_grad_(False)

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Map (n, c, h, w) maps to (n, K * D) unit descriptors."""
        residuals = self.residuals(self.compress(maps))
        return (residuals / self.lengths(residuals)).sum((2, 3))

    def lengths(self, residuals: torch.Tensor) -> torch.Tensor:
        """Return what each channel is divided by, (n, K * D, 1, 1): the length of its cluster and of the whole."""
        sums = residuals.detach().sum((2, 3)).unflatten(1, (self.count, -1))
        within = sums.norm(dim=-1, keepdim=True)
        whole = (within > 0).sum(1, keepdim=True).sqrt()
        return (within * whole).clamp_min(torch.finfo(sums.dtype).tiny).expand_as(sums).flatten(1)[:, :, None, None]


def _projection(config: Config, arrays: dict[str, np.ndarray]) -> nn.Module:
    """Return a fitted `ChannelKL` as a convolution; what it does to zero and to unit vectors is all of it."""
    if not arrays:
        return nn.Identity()
    kl = ChannelKL.from_arrays(arrays, **config.compression.model_dump(exclude={"reading"}))
    channels = len(kl.mean_)
    origin = kl.transform(np.zeros((1, channels)))
    convolution = nn.Conv2d(channels, kl.n_components_, 1)
    convolution.weight.data = torch.from_numpy((kl.transform(np.eye(channels)) - origin).T[:, :, None, None].copy())
    convolution.bias.data = torch.from_numpy(origin[0])
    return convolution


class Explainer:
    """Heat maps for a fitted method.

    Parameters
    ----------
    method : Method
        Fitted.

    Raises
    ------
    ConfigError
        If the method has no such descriptor, or the package grad-cam is not installed.
    """

    def __init__(self, method: Method) -> None:
        self._method = method
        self._network = DescriptorNetwork(method).eval()
        self._cam = _grad_cam()(self._network, [self._network.residuals])

    def look(self, image: np.ndarray, mean: np.ndarray | None = None, *, before: np.ndarray | None = None) -> View:
        """Describe an image by NetVLAD.

        Parameters
        ----------
        image : ndarray of uint8, shape (H, W, 3)
            RGB.
        mean : ndarray of float32, shape (K * D,) or longer, optional
            What is taken out of the descriptor.
        before : ndarray of uint8, shape (H, W, 3), optional
            The frame of the drive since which the view must have changed to count, see
            `loopclosure.aggregation.change`; without it all positions count.
        """
        features = self._method.features([image] if before is None else [before, image])
        maps, weights = features[-1], np.ones(features[-1].shape[:2], np.float32)
        if before is not None and self._method.window > 1:
            weights = change(maps, features[0])
        self._network.residuals.weights_of_positions = torch.from_numpy(weights)
        with torch.no_grad():
            codes = self._network.compress(_tensor(maps))
            residuals = self._network.residuals(codes)
            parts = (residuals / self._network.lengths(residuals))[0].permute(1, 2, 0).numpy()
            clusters = self._network.residuals.clusters(codes)[0].numpy()
        plain = self._method.describe(features)[: parts.shape[-1]]  # what stands behind NetVLAD is the layout
        mean = np.zeros_like(plain) if mean is None else mean[: plain.size]
        parts = parts.reshape(*maps.shape[:2], self._network.count, -1)
        return View(image, maps, weights, parts, clusters, mean, unit(plain - mean))

    def heat(self, view: View, other: View) -> np.ndarray:
        """Return where the similarity of the two descriptors comes from, by Grad-CAM.

        Parameters
        ----------
        view : View
            Whose positions are asked for.
        other : View
            What it is compared with; `view` itself for what its own descriptor is made of.

        Returns
        -------
        ndarray of float32, shape (H, W)
            0: nothing, or against the similarity; 1: most.
        """
        self._network.residuals.weights_of_positions = torch.from_numpy(view.weights)
        heat = self._cam(_tensor(view.maps).requires_grad_(), [_dot(other.descriptor)])[0]
        height, width = view.image.shape[:2]
        return np.clip(cv2.resize(heat, (width, height), interpolation=cv2.INTER_CUBIC), 0, 1)


def cosine(left: View, right: View) -> float:
    """Return the cosine of two centred descriptors; the score of the two frames alone is ``(1 + cosine) / 2``."""
    return float(left.descriptor @ right.descriptor)


def matches(left: View, right: View, most: int = 10) -> list[Match]:
    """Return the pairs of positions that add most to the cosine, each the best partner of the other.

    The cosine is the sum over all pairs of positions, because each descriptor is the sum over its own.
    """
    pairs = _evenly_centred(left) @ _evenly_centred(right).T
    best_right, best_left = pairs.argmax(1), pairs.argmax(0)
    rows = np.flatnonzero(best_left[best_right] == np.arange(len(pairs))).tolist()
    found = [(i, int(best_right[i]), pairs[i, best_right[i]]) for i in rows if pairs[i, best_right[i]] > 0]
    shapes = left.clusters.shape, right.clusters.shape
    return [
        Match(_place(i, shapes[0]), _place(j, shapes[1]), float(share))
        for i, j, share in sorted(found, key=lambda pair: -pair[2])[:most]
    ]


def cluster_shares(left: View, right: View) -> np.ndarray:
    """Return what each cluster adds to the cosine, float32 (K,)."""
    clusters = left.residuals.shape[2]
    return (left.descriptor * right.descriptor).reshape(clusters, -1).sum(1)


def _evenly_centred(view: View) -> np.ndarray:
    """Return what each position adds to the centred descriptor, (h * w, K * D)."""
    shares = view.residuals.reshape(view.clusters.size, -1)
    centred = shares - view.mean / len(shares)
    return centred / max(float(np.linalg.norm(centred.sum(0))), float(np.finfo(np.float32).tiny))


def _place(position: int, shape: tuple[int, ...]) -> tuple[int, int]:
    return position // shape[1], position % shape[1]


def _tensor(maps: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(maps).permute(2, 0, 1)[None]


def _dot(descriptor: np.ndarray) -> Callable[[torch.Tensor], torch.Tensor]:
    other = torch.from_numpy(descriptor)
    return lambda output: output @ other


def _grad_cam() -> Any:
    try:
        from pytorch_grad_cam import GradCAM
    except ImportError:
        raise ConfigError("heat maps need grad-cam: pip install 'loopclosure[explain]'") from None
    return GradCAM
