"""From settings to the network that makes feature maps, whatever executes it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Protocol

import numpy as np

from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.store import EXPORTED
from loopclosure.weights import DEFAULTS, Progress

if TYPE_CHECKING:
    from loopclosure.images.preprocess import Preprocessing


class MapNetwork(Protocol):
    """What turns images into feature maps."""

    @property
    def weights_name(self) -> str:
        """Which weights made the maps."""

    @property
    def weights_sha256(self) -> str | None:
        """Digest of their file; None for random weights."""

    @property
    def preprocessing(self) -> Preprocessing:
        """Images to the input of the network."""

    def maps(self, images: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Turn n uint8 RGB images (h, w, 3) into float32 (n, h, w, c) by the name of the layer."""


def open_network(config: Config, *, progress: Progress | None = None) -> MapNetwork:
    """Open the network that the section `features` names.

    Parameters
    ----------
    config : Config
        ``features.backbone`` is a name of `loopclosure.features.backbones.BACKBONES`, or ``onnx``;
        ``features.backend`` says what executes it. Weights that are the file ``bundle.json`` of an exported network
        run without torch.
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
    if os.path.basename(features.weights) == EXPORTED:
        from loopclosure.features.exported import open_exported

        return open_exported(features)
    try:
        return _runtime(features.backend, features.backbone)(
            features.backbone,
            features.layer,
            weights=features.weights,
            height=features.height,
            width=features.width,
            progress=progress,
        )
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        raise ConfigError(
            f"the network {features.backbone} is read by torch, which is not installed; pip install torch torchvision, "
            "or run a bundle that `loopclosure export` made where torch is"
        ) from None


def _runtime(backend: str, backbone: str) -> Callable[..., MapNetwork]:
    """Return what executes a backbone: OpenVINO where it is installed, else torch, on a GPU if there is one."""
    if backend != "torch" and backbone in DEFAULTS:  # torch knows best what to say of an unknown backbone
        try:
            from loopclosure.features.openvino_runtime import OpenVinoBackbone, import_openvino

            import_openvino()
        except ImportError as error:
            if backend == "openvino":
                raise ConfigError(f"features.backend = openvino: {error}; pip install openvino") from None
        else:
            return OpenVinoBackbone
    import torch

    from loopclosure.features.backbones import Backbone

    return partial(Backbone, device="cuda" if torch.cuda.is_available() else "cpu")
