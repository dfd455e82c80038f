"""Any network that describes an image by one vector, brought by the user as an ONNX file."""

from __future__ import annotations

from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.features.onnx_network import OnnxNetwork
from loopclosure.methods.vectors import VectorMethod

THRESHOLD = 2.4


def onnx(config: Config) -> VectorMethod:
    """Build the method `onnx` from the file that ``onnx.path`` names; see `OnnxNetwork` for the JSON beside it.

    A network that gives feature maps belongs in front of KL and NetVLAD: ``--method kl-netvlad --backbone onnx``.

    Raises
    ------
    ConfigError, WeightsError
        If ONNX Runtime is not installed, or the file cannot be used.
    """
    if config.features.backbone != "onnx":
        raise ConfigError(f"the method onnx runs the network of onnx.path, found backbone {config.features.backbone}")
    network = OnnxNetwork(config.onnx.path)
    provenance = {"weights": network.weights_name, "weights_sha256": network.weights_sha256}
    return VectorMethod(config, network.vectors, provenance=provenance, threshold=THRESHOLD)
