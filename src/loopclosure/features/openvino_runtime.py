"""Backbones executed by OpenVINO on the processor: converted once, checked against torch, kept on disk.

A second start reads the kept graph and imports no torch. OpenVINO's package counts its own imports on a server of its
makers; the library takes it without that part, so that nothing leaves the machine.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import sys
import tempfile
import threading
import warnings
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from loopclosure.images.preprocess import Preprocessing
from loopclosure.weights import Progress, cache_folder, file_sha256, is_cached, locate, weights_for

if TYPE_CHECKING:
    from loopclosure.features.backbones import Backbone

LEAST_COSINE = 0.9999
"""Of the maps of a compiled network to those of torch in single precision; below it a precision is not used.

Descriptors are to agree to 0.999, and what is missing to 1 grows about sixteenfold from maps to descriptors: maps of
EfficientNet-Lite0 in bfloat16 agree to 0.9985 on photographs, its descriptors to 0.976.
"""

_FILE = "network.xml"
_PRECISION = ["loopclosure", "precision"]
_log = logging.getLogger(__name__)


class OpenVinoBackbone:
    """What `loopclosure.features.backbones.Backbone` is, compiled for this processor.

    It computes in bfloat16 where the processor can and the maps agree with torch's in single precision (cosine at
    least `LEAST_COSINE` on each of some made images), else in single precision. Calls from several threads take turns.

    Parameters
    ----------
    name, layers, weights, height, width, progress
        As for `Backbone`.

    Attributes
    ----------
    precision : str
        ``"bf16"`` or ``"f32"``.
    preprocessing : Preprocessing
        Images to the input of the network.
    weights_name : str
        Name of the weights.
    weights_sha256 : str or None
        Of their file; None for random weights.

    Raises
    ------
    ConfigError, WeightsError
        As `Backbone`.
    ImportError
        If OpenVINO is not installed.
    """

    def __init__(
        self,
        name: str,
        layers: str | tuple[str, ...],
        *,
        weights: str = "default",
        height: int = 224,
        width: int = 224,
        progress: Progress | None = None,
    ) -> None:
        def build() -> Backbone:
            from loopclosure.features.backbones import Backbone

            return Backbone(name, layers, weights=weights, height=height, width=width, progress=progress)

        core = import_openvino().Core()
        record = weights_for(name, weights)
        self.layers = (layers,) if isinstance(layers, str) else tuple(layers)
        self.weights_name = record.name
        backbone = None if record.random or is_cached(record) else build()  # which checks everything, then fetches
        self.weights_sha256 = None if record.random else file_sha256(locate(record))
        folder = _folder(core, name, record.variant, self.weights_name, self.weights_sha256, self.layers, height, width)
        model = _kept(core, folder)
        if model is None:
            model = converted(core, backbone or build())
            _keep(model, folder)
        self.preprocessing = Preprocessing(height, width, record.mean, record.std)
        self.precision = precision_of(model)
        self._graph = Graph(core, model, self.layers, self.precision)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """(h, w, c) of each tap's map."""
        return self._graph.shapes

    def maps(self, images: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
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

    def compute(self, batch: np.ndarray) -> dict[str, np.ndarray]:
        """Compute the maps of a batch that `preprocessing` made, float32 (n, 3, height, width)."""
        return self._graph.compute(batch)


class Graph:
    """An OpenVINO graph, compiled for this processor; calls from several threads take turns.

    Parameters
    ----------
    core : openvino.Core
    model : openvino.Model
        One input, one output (n, h, w, c) a layer.
    layers : tuple of str
        Names of the outputs.
    precision : str
        ``"bf16"``, where the processor can, or ``"f32"``.

    Attributes
    ----------
    shapes : dict of str to tuple of 3 int
        (h, w, c) of each output.
    """

    def __init__(self, core: Any, model: Any, layers: tuple[str, ...], precision: str) -> None:
        self.shapes = {
            layer: tuple(output.partial_shape[axis].get_length() for axis in (1, 2, 3))
            for layer, output in zip(layers, model.outputs, strict=True)
        }
        self._layers = layers
        usable = precision if precision in _precisions(core) else "f32"
        self._request = compile_for_cpu(core, model, usable).create_infer_request()
        self._lock = threading.Lock()

    def compute(self, batch: np.ndarray) -> dict[str, np.ndarray]:
        """Compute the maps of a prepared batch, float32 (n, 3, height, width)."""
        with self._lock:
            return dict(zip(self._layers, _run(self._request, batch), strict=True))


def import_openvino() -> Any:
    """Return the package `openvino`, imported without the part that reports its use over the network.

    Raises
    ------
    ImportError
        If it is not installed.
    """
    name = "openvino_telemetry"
    absent = name not in sys.modules
    if absent:
        sys.modules[name] = None  # type: ignore[assignment]  # an ImportError inside openvino, which has a stand-in
    try:
        import openvino
    finally:
        if absent:
            del sys.modules[name]
    return openvino


def converted(core: Any, backbone: Backbone) -> Any:
    """Return the graph of a backbone, maps channels last, that knows the precision to run in."""
    import torch

    ov = import_openvino()
    images = made_images(backbone.preprocessing)
    size = (3, backbone.preprocessing.height, backbone.preprocessing.width)
    with warnings.catch_warnings(), torch.inference_mode():
        warnings.simplefilter("ignore")  # how OpenVINO reads torch networks is its own affair
        model = ov.convert_model(backbone.module, example_input=torch.zeros(1, *size), input=[-1, *size])
    steps = ov.preprocess.PrePostProcessor(model)
    for index in range(len(backbone.layers)):
        steps.output(index).model().set_layout(ov.Layout("NCHW"))
        steps.output(index).tensor().set_layout(ov.Layout("NHWC"))
    model = steps.build()
    wanted = list(backbone.maps(images).values())
    batch = backbone.preprocessing.batch(images)
    for precision in _precisions(core):
        found = _run(compile_for_cpu(core, model, precision).create_infer_request(), batch)
        cosine = min(map(least_cosine, found, wanted))
        if cosine >= LEAST_COSINE:
            break
        _log.info("%s in %s agrees with torch only to a cosine of %.4f", backbone.name, precision, cosine)
    else:
        _log.warning("%s computed by OpenVINO differs from torch; features.backend = torch is safer", backbone.name)
    model.set_rt_info(precision, _PRECISION)
    return model


def precision_of(model: Any) -> str:
    """Return what a graph that `converted` made is to be computed in."""
    return str(model.get_rt_info(_PRECISION).astype(str))


def _precisions(core: Any) -> list[str]:
    """Return what this processor can compute in, the fastest first."""
    return ["bf16"] * ("BF16" in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")) + ["f32"]


def compile_for_cpu(core: Any, model: Any, precision: str) -> Any:
    """Return an OpenVINO graph compiled for one request at a time on all threads that the environment allows."""
    settings = {"INFERENCE_PRECISION_HINT": precision, "PERFORMANCE_HINT": "LATENCY"}
    threads = os.environ.get("OMP_NUM_THREADS", "")
    if threads.isdecimal():  # OpenVINO's own thread pool does not look at it
        settings["INFERENCE_NUM_THREADS"] = threads
    return core.compile_model(model, "CPU", settings)


def _run(request: Any, batch: np.ndarray) -> list[np.ndarray]:
    request.infer([batch], share_inputs=True)
    return [tensor.data.copy() for tensor in request.output_tensors]


def made_images(preprocessing: Preprocessing) -> list[np.ndarray]:
    """Return pictures with structure at several scales, always the same."""
    rng = np.random.default_rng(0)
    size = (preprocessing.width, preprocessing.height)
    coarse = (rng.integers(0, 256, (cells, cells, 3), np.uint8) for cells in (4, 12, 32, 96))
    return [cv2.resize(image, size, interpolation=cv2.INTER_CUBIC) for image in coarse]


def least_cosine(found: np.ndarray, wanted: np.ndarray) -> float:
    """Return the smallest cosine of the rows of two arrays (n, ...); -1 where a number is not finite."""
    a, b = (array.reshape(len(array), -1).astype(np.float64) for array in (found, wanted))
    if not np.isfinite(a).all():
        return -1.0
    return float(((a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-30)).min())


def _folder(core: Any, *made_of: Any) -> Path:
    """Return where the graph is kept that was made of these, by these versions, for this processor."""
    versions = [*map(metadata.version, ("loopclosure", "openvino", "torch")), _precisions(core), LEAST_COSINE]
    key = hashlib.sha256(json.dumps([made_of, versions]).encode()).hexdigest()[:16]
    return cache_folder().parent / "networks" / f"{made_of[0]}-{key}"


def _kept(core: Any, folder: Path) -> Any:
    """Return the graph that is kept in a folder, None where there is none or it is damaged."""
    if not (folder / _FILE).is_file():
        return None
    try:
        return core.read_model(folder / _FILE)
    except RuntimeError as error:
        _log.warning("%s is damaged and made anew: %s", folder, str(error).splitlines()[0])
        shutil.rmtree(folder, ignore_errors=True)
        return None


def _keep(model: Any, folder: Path) -> None:
    """Write a graph; its folder appears when it is whole."""
    part = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        part = tempfile.mkdtemp(prefix=f"{folder.name}.", suffix=".part", dir=folder.parent)
        import_openvino().save_model(model, Path(part) / _FILE, compress_to_fp16=False)
        os.replace(part, folder)
    except (OSError, RuntimeError) as error:  # another process may have been faster
        if not folder.is_dir():
            _log.warning("the converted network is not kept: %s", str(error).splitlines()[0])
    finally:
        if part is not None:
            shutil.rmtree(part, ignore_errors=True)
