"""The user's own network: an ONNX file, and beside it a small JSON that says how it wants its images."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from loopclosure.config import Section
from loopclosure.errors import ConfigError, WeightsError, did_you_mean
from loopclosure.images.preprocess import Preprocessing

MAX_NETWORK_BYTES = 2 << 30  # what a protocol buffer can hold
MAX_HEADER_BYTES = 1 << 16
MAX_NUMBERS = 1 << 24
"""A larger output of one image is refused."""


class OnnxHeader(Section):
    """What ``NETWORK.json`` says of ``NETWORK.onnx``.

    Examples
    --------
    >>> OnnxHeader(height=224, width=224).layout
    'nchw'
    """

    height: int = Field(ge=1, le=4096, description="input height, pixels")
    width: int = Field(ge=1, le=4096, description="input width, pixels")
    mean: tuple[float, float, float] = Field((0.485, 0.456, 0.406), description="of red, green, blue in 0..1")
    std: tuple[float, float, float] = Field((0.229, 0.224, 0.225), description="of red, green, blue in 0..1")
    output: str = Field("", description="name of the output; '' = the first one")
    layout: Literal["nchw", "nhwc"] = Field("nchw", description="order of the axes of the input and of a map")


class OnnxNetwork:
    """A network in an ONNX file, executed by ONNX Runtime on the processor.

    Its one input takes RGB images, one at a time. An output of two axes is one vector an image, an output of four is a
    feature map. Where a network returns numbers that are not finite, as many do for a black image, the whole image
    counts as blank: zeros.

    Parameters
    ----------
    path : path
        ``NETWORK.onnx``, one file that holds everything; ``NETWORK.json`` beside it is an `OnnxHeader`.

    Attributes
    ----------
    header : OnnxHeader
    weights_name, weights_sha256 : str
        Name and SHA-256 of the file.

    Raises
    ------
    ConfigError
        If no path is given, or ONNX Runtime is not installed.
    WeightsError
        If one of the files is missing, damaged or too large, or they contradict each other.
    """

    layer = "output"

    def __init__(self, path: str | os.PathLike[str]) -> None:
        if not os.fspath(path):
            raise ConfigError("no network was named: set onnx.path to a file NETWORK.onnx with NETWORK.json beside it")
        file = Path(path).expanduser()
        self.header = _read_header(file.with_suffix(".json"))
        content = _read(file, MAX_NETWORK_BYTES)
        self.weights_name = file.name
        self.weights_sha256 = hashlib.sha256(content).hexdigest()
        self.preprocessing = Preprocessing(self.header.height, self.header.width, self.header.mean, self.header.std)
        self._session = _session(file, content)
        self._input = _checked_input(file, self._session, self.header)
        self._output = _checked_output(file, self._session, self.header)

    def maps(self, images: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Compute the feature maps of several images.

        Parameters
        ----------
        images : sequence of n uint8 (h, w, 3)
            RGB, any size; may be empty.

        Returns
        -------
        dict of str to float32 (n, h, w, c)
            The one entry is `layer`.
        """
        maps = self._run(images, axes=4, wanted="a feature map")
        if self.header.layout == "nchw":
            maps = maps.transpose(0, 2, 3, 1)
        return {self.layer: np.ascontiguousarray(maps)}

    def vectors(self, images: Sequence[np.ndarray]) -> np.ndarray:
        """Compute one vector an image.

        Parameters
        ----------
        images : sequence of n uint8 (h, w, 3)
            RGB, any size; may be empty.

        Returns
        -------
        ndarray of float32, shape (n, d)
        """
        return self._run(images, axes=2, wanted="one vector an image")

    def _run(self, images: Sequence[np.ndarray], *, axes: int, wanted: str) -> np.ndarray:
        rows = [self._run_one(image) for image in images]
        shapes = {row.shape for row in rows} or {(0,) * (axes - 1)}
        shape = shapes.pop()
        if shapes or len(shape) != axes - 1:
            raise WeightsError(
                f"{self.weights_name}: output '{self._output}' has the shape {('n', *shape)}, wanted {wanted}; "
                "a map wants --method kl-netvlad --backbone onnx, a vector wants --method onnx"
            )
        return np.stack(rows) if rows else np.empty((0, *shape), np.float32)

    def _run_one(self, image: np.ndarray) -> np.ndarray:
        batch = self.preprocessing.batch([image])
        if self.header.layout == "nhwc":
            batch = np.ascontiguousarray(batch.transpose(0, 2, 3, 1))
        try:
            (found,) = self._session.run([self._output], {self._input: batch})
        except Exception as error:  # noqa: BLE001 - whatever a network of unknown origin does wrong
            raise WeightsError(f"{self.weights_name} cannot be run: {_first_line(error)}") from None
        if not isinstance(found, np.ndarray) or len(found) != 1 or found.size > MAX_NUMBERS:
            raise WeightsError(f"{self.weights_name}: output '{self._output}' is not one row for one image")
        row = found[0].astype(np.float32)
        return row if np.isfinite(row).all() else np.zeros_like(row)


def _read(file: Path, most: int) -> bytes:
    try:
        if file.stat().st_size > most:
            raise WeightsError(f"{file} is larger than {most} bytes: that is not read")
        return file.read_bytes()
    except OSError as error:
        raise WeightsError(f"cannot read {file}: {error.strerror or error}") from None


def _read_header(file: Path) -> OnnxHeader:
    try:
        values = json.loads(_read(file, MAX_HEADER_BYTES))
        return OnnxHeader.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        guess = did_you_mean(name, OnnxHeader.model_fields) if first["type"] == "extra_forbidden" else ""
        raise WeightsError(f"{file}: '{name}': {first['msg'][0].lower()}{first['msg'][1:]}{guess}") from None
    except (ValueError, RecursionError) as error:
        raise WeightsError(f"{file} is not readable JSON: {error}") from None


def _session(file: Path, content: bytes) -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise ConfigError("networks in ONNX files need onnxruntime: pip install 'loopclosure[onnx]'") from None
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # what goes wrong is raised, not printed
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    try:
        # From memory, so that a file cannot pull in other ones, and the hash covers everything.
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # noqa: BLE001 - a damaged or hostile file can raise anything
        raise WeightsError(f"{file} is no ONNX network that can be run here: {_first_line(error)}") from None


def _checked_input(file: Path, session: Any, header: OnnxHeader) -> str:
    inputs = session.get_inputs()
    sizes = {"n": 1, "c": 3, "h": header.height, "w": header.width}
    wanted = [sizes[axis] for axis in header.layout]
    found = inputs[0].shape if len(inputs) == 1 and inputs[0].type == "tensor(float)" else None
    if (
        not isinstance(found, list)
        or len(found) != 4
        or any(isinstance(size, int) and size != want for size, want in zip(found, wanted, strict=True))
    ):
        described = [(one.name, one.type, one.shape) for one in inputs]
        raise WeightsError(f"{file} has the inputs {described}, wanted one of tensor(float) that takes {wanted}")
    return str(inputs[0].name)


def _checked_output(file: Path, session: Any, header: OnnxHeader) -> str:
    known = [output.name for output in session.get_outputs()]
    name = header.output or known[0]
    if name not in known:
        raise WeightsError(f"{file} has no output '{name}'{did_you_mean(name, known)}; it has {', '.join(known)}")
    return str(name)


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".splitlines()[0][:200]
