"""A detector of objects as a detector of loops: what the regions of Faster R-CNN show, in one vector.

Jiang et al. 2024 compare with Faster R-CNN (Ren et al. 2015) and do not say how an image is described. Here: the
features of torchvision's ResNet-50 feature pyramid (COCO weights), averaged over each of the 100 likeliest region
proposals; of these the mean weighted by the region's score, and the maximum of score times feature, each scaled to
length 1, side by side. The boxes themselves and the classes of the objects are not used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from loopclosure.aggregation.netvlad import unit
from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.features.regions import BACKBONE, CHANNELS, RegionNetwork, Regions
from loopclosure.methods.vectors import VectorMethod

THRESHOLD = 2.4


def faster_rcnn(config: Config, *, progress: Callable[[int, int], None] | None = None) -> VectorMethod:
    """Build the method `faster-rcnn`.

    Raises
    ------
    ConfigError
        If the settings name another network: no other one has region proposals.
    WeightsError
        If the weights are not to be had or do not fit.
    """
    features = config.features
    if (features.backbone, features.layer) != (BACKBONE, "fpn"):
        raise ConfigError(
            f"faster-rcnn runs on {BACKBONE} and its layer fpn alone, found {features.backbone}, {features.layer}"
        )
    network = RegionNetwork(weights=features.weights, height=features.height, width=features.width, progress=progress)

    def describe(images: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [pool_regions(regions) for regions in network.regions(images)]

    provenance = {"weights": network.weights_name, "weights_sha256": network.weights_sha256}
    return VectorMethod(config, describe, provenance=provenance, threshold=THRESHOLD)


def pool_regions(regions: Regions) -> np.ndarray:
    """Return the score-weighted mean and maximum of the region vectors.

    Parameters
    ----------
    regions : Regions
        Of one image.

    Returns
    -------
    ndarray of float32, shape (512,)
        Both halves have length 1; zeros for an image without regions.
    """
    if not len(regions.scores):
        return np.zeros(2 * CHANNELS, np.float32)
    weighted = regions.scores[:, None] * regions.vectors
    return np.concatenate([unit(weighted.sum(axis=0)), unit(weighted.max(axis=0))])
