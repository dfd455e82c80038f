"""From settings to the network that makes feature maps, whatever executes it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.weights import Progress


class MapNetwork(Protocol):
    """What turns images into feature maps."""

    @property
    def weights_name(self) -> str:
        """Which weights made the maps."""

    @property
    def weights_sha256(self) -> str | None:
        """Digest of their file; None for random weights."""

    def maps(self, images: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Turn n uint8 RGB images (h, w, 3) into float32 (n, h, w, c) by the name of the layer."""


def open_network(config: Config, *, progress: Progress | None = None) -> MapNetwork:
    """Open the network that the section `features` names.

    Parameters
    ----------
    config : Config
        ``features.backbone`` is a name of `loopclosure.features.backbones.BACKBONES`, or ``onnx``.
    progress : callable, optional
        Told ``(arrived, in_all)`` bytes while weights are downloaded.

    Raises
    ------
    ConfigError, WeightsError
        If the settings or the weights cannot be used.
    """
    features = config.features
    if features.backbone == "onnx":
        from loopclosure.features.onnx_network import OnnxNetwork

        if features.layer != OnnxNetwork.layer:
            raise ConfigError(
                f"features.layer = '{features.layer}': an ONNX network has only '{OnnxNetwork.layer}', "
                "the output that its JSON names"
            )
        return OnnxNetwork(config.onnx.path)
    from loopclosure.features.backbones import Backbone

    return Backbone(
        features.backbone,
        features.layer,
        weights=features.weights,
        height=features.height,
        width=features.width,
        progress=progress,
    )
