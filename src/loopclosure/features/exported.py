"""A network that was taken out of torch: OpenVINO's format and ONNX side by side, run by whichever is installed.

`loopclosure.bundle` writes it. ``bundle.json`` says what it was made from and the hash of each file; ``network.json``
is what `OnnxNetwork` wants beside ``network.onnx``, so that these two are also a network that ``onnx.path`` can name.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, ValidationError

from loopclosure.config import Features, Section, one_line
from loopclosure.errors import ConfigError, ModelError
from loopclosure.features.onnx_network import MAX_HEADER_BYTES, MAX_NETWORK_BYTES, MAX_NUMBERS, OnnxNetwork
from loopclosure.features.openvino_runtime import Graph, import_openvino
from loopclosure.images.preprocess import Preprocessing
from loopclosure.store import EXPORTED_FILES
from loopclosure.weights import file_sha256

Runtime = Literal["openvino", "onnx"]
_Maps = Callable[[Sequence[np.ndarray]], np.ndarray]


class ExportedCard(Section):
    """What ``bundle.json`` says of the network."""

    format: Literal[1] = Field(1, description="of this file")
    backbone: str = Field(description="network")
    layer: str = Field(description="its one output")
    height: int = Field(ge=1, le=4096, description="input height, pixels")
    width: int = Field(ge=1, le=4096, description="input width, pixels")
    mean: tuple[float, float, float] = Field(description="of red, green, blue in 0..1")
    std: tuple[float, float, float] = Field(description="of red, green, blue in 0..1")
    weights: str = Field(description="name of the weights")
    weights_sha256: str | None = Field(description="of the file that torch read; none for random weights")
    precision: Literal["bf16", "f32"] = Field(description="what OpenVINO computes in, where the processor can")
    sha256: dict[str, str] = Field(description="of each file beside this one")


class ExportedNetwork:
    """What `loopclosure.features.backbones.Backbone` is, without torch.

    Parameters
    ----------
    path : path
        ``bundle.json``, with the files that it names beside it.
    runtime : {"openvino", "onnx"}, optional
        What executes the network; without it OpenVINO where that is installed, else ONNX Runtime.

    Attributes
    ----------
    card : ExportedCard
    preprocessing : Preprocessing
        Images to the input of the network.
    weights_name : str
        Of what torch read.
    weights_sha256 : str or None
        Of what torch read; None for random weights.

    Raises
    ------
    ConfigError
        If the runtime is not installed.
    ModelError, WeightsError
        If a file is missing, damaged or too large, or is no such network.
    """

    def __init__(self, path: str | os.PathLike[str], *, runtime: Runtime | None = None) -> None:
        self.card = card = _read_card(Path(path))
        folder = Path(path).parent
        for name in EXPORTED_FILES:
            _check_file(folder / name, card.sha256.get(name))
        self.weights_name, self.weights_sha256 = card.weights, card.weights_sha256
        self.preprocessing = Preprocessing(card.height, card.width, card.mean, card.std)
        self._maps = _by_onnx(folder) if _chosen(runtime) == "onnx" else _by_openvino(folder, card, self.preprocessing)

    def maps(self, images: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Compute the feature maps of several images.

        Parameters
        ----------
        images : sequence of n uint8 (h, w, 3)
            RGB, any size; may be empty.

        Returns
        -------
        dict of str to float32 (n, h, w, c)
            The one entry is the layer of `card`.
        """
        return {self.card.layer: self._maps(images)}


def open_exported(features: Features) -> ExportedNetwork:
    """Open the network whose ``bundle.json`` is ``features.weights``.

    Raises
    ------
    ConfigError
        If the settings want another network, layer or size, or torch.
    ModelError
        If it is damaged.
    """
    if features.backend == "torch":
        raise ConfigError("features.backend = torch: a bundle holds no torch network; use the model it was made from")
    network = ExportedNetwork(features.weights, runtime="openvino" if features.backend == "openvino" else None)
    for name in ("backbone", "layer", "height", "width"):
        wanted, found = getattr(features, name), getattr(network.card, name)
        if wanted != found:
            raise ConfigError(f"{features.weights} was exported with features.{name} = {found}, wanted {wanted}")
    return network


def _read_card(file: Path) -> ExportedCard:
    try:
        if file.stat().st_size > MAX_HEADER_BYTES:
            raise ModelError(f"{file} is larger than {MAX_HEADER_BYTES} bytes: it is not ours or is damaged")
        return ExportedCard.model_validate_json(file.read_bytes())
    except OSError as error:
        raise ModelError(f"cannot read {file}: {error.strerror or error}") from None
    except ValidationError as error:
        raise ModelError(f"{file} is damaged: {one_line(error)}") from None


def _check_file(file: Path, sha256: str | None) -> None:
    try:
        if file.stat().st_size > MAX_NETWORK_BYTES:
            raise ModelError(f"{file} is larger than {MAX_NETWORK_BYTES} bytes: that is not read")
        if file_sha256(file) != sha256:
            raise ModelError(f"{file} is not the file that was exported: it is damaged or was replaced; export again")
    except OSError as error:
        raise ModelError(f"cannot read {file}: {error.strerror or error}; copy the bundle as a whole") from None


def _chosen(runtime: Runtime | None) -> Runtime:
    if runtime == "onnx":
        return runtime
    try:
        import_openvino()
    except ImportError as error:
        if runtime == "openvino":
            raise ConfigError(f"features.backend = openvino: {error}; pip install openvino") from None
        return "onnx"
    return "openvino"


def _by_openvino(folder: Path, card: ExportedCard, preprocessing: Preprocessing) -> _Maps:
    core, file = import_openvino().Core(), folder / "network.xml"
    try:
        model = core.read_model(file)
        found = str(model.input().partial_shape), model.output().partial_shape.rank.get_length()
        shape = tuple(model.output().partial_shape[axis].get_length() for axis in range(1, found[1]))
        if found != (f"[?,3,{card.height},{card.width}]", 4) or math.prod(shape) > MAX_NUMBERS:
            raise ModelError(f"{file} maps {found[0]} to {shape}, wanted [?,3,{card.height},{card.width}] to (h, w, c)")
        graph = Graph(core, model, (card.layer,), card.precision)
    except RuntimeError as error:
        raise ModelError(f"{file} is no network that can be run here: {str(error).splitlines()[0]}") from None

    def maps(images: Sequence[np.ndarray]) -> np.ndarray:
        if not len(images):
            return np.empty((0, *shape), np.float32)
        return graph.compute(preprocessing.batch(images))[card.layer]

    return maps


def _by_onnx(folder: Path) -> _Maps:
    network = OnnxNetwork(folder / "network.onnx")
    return lambda images: network.maps(images)[network.layer]
