"""What is learned is saved as arrays plus a JSON header; nothing that is loaded can run code."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from loopclosure.config import Config
from loopclosure.errors import ModelError
from loopclosure.weights import file_sha256

FORMAT = 2
HEADER, ARRAYS = "header.json", "arrays.safetensors"
TRAINED = "backbone.safetensors"
"""Weights of a trained network; a saved folder carries its own copy, so that it can be moved."""
EXPORTED = "bundle.json"
"""Says what an exported network consists of; a saved folder carries its own copy of that too."""
EXPORTED_FILES = ("network.xml", "network.bin", "network.onnx", "network.json")
_CARRIED = {TRAINED: (TRAINED,), EXPORTED: (*EXPORTED_FILES, EXPORTED)}
MAX_HEADER_BYTES = 1 << 20
_FREE = (
    "images.",
    "learning.",
    "training.",
    "matching.",
    "sequence.",
    "decision.",
    "verification.",
    "aggregation.centre",
    "features.backend",
)
"""Settings that a model was not fitted for, by how their names begin."""


def save_arrays(
    folder: str | os.PathLike[str], *, kind: str, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> Path:
    """Write `arrays` and `header` into `folder`; each file appears only when it is whole.

    Parameters
    ----------
    folder : path
        Made if it is absent.
    kind : str
        What this is (``model``, ``detector`` ...); checked when it is loaded.
    header : mapping
        Anything that JSON can hold: configuration, provenance.
    arrays : mapping of str to ndarray
        Numeric arrays.

    Returns
    -------
    pathlib.Path
        The folder.
    """
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    arrays_part, header_part = path / f"{ARRAYS}.part", path / f"{HEADER}.part"
    save_file({name: np.asarray(array, order="C") for name, array in arrays.items()}, arrays_part)
    text = {**header, "format": FORMAT, "kind": kind, "arrays_sha256": file_sha256(arrays_part)}
    header_part.write_text(json.dumps(text, indent=2) + "\n", encoding="utf-8")
    os.replace(arrays_part, path / ARRAYS)
    os.replace(header_part, path / HEADER)
    return path


def load_header(folder: str | os.PathLike[str], *, kind: str) -> dict[str, Any]:
    """Read the header alone; see `load_arrays`."""
    path = Path(folder)
    if not (path / HEADER).is_file():
        raise ModelError(f"{path} holds no {HEADER}: it is not a folder that loopclosure saved")
    if (path / HEADER).stat().st_size > MAX_HEADER_BYTES:
        raise ModelError(f"{path / HEADER} is larger than {MAX_HEADER_BYTES} bytes: it is not ours or is damaged")
    try:
        header = json.loads((path / HEADER).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ModelError(f"{path / HEADER} is not readable JSON: {error}") from None
    if not isinstance(header, dict) or header.get("kind") != kind:
        found = header.get("kind") if isinstance(header, dict) else type(header).__name__
        raise ModelError(f"{path} holds '{found}', wanted '{kind}'")
    if header.get("format") != FORMAT:
        raise ModelError(
            f"{path} has format {header.get('format')}, this version reads format {FORMAT}: it was saved by another "
            "version; make it again"
        )
    return header


def load_arrays(folder: str | os.PathLike[str], *, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read what `save_arrays` wrote.

    Returns
    -------
    header : dict
        As it was saved, with ``format`` and ``kind``.
    arrays : dict of str to ndarray
        Memory of their own, writable.

    Raises
    ------
    ModelError
        If a file is missing or damaged, or holds another kind or another format.
    """
    header, file = load_header(folder, kind=kind), Path(folder) / ARRAYS
    try:
        if file_sha256(file) != header.get("arrays_sha256"):
            raise ModelError(f"{file} and its {HEADER} do not belong together: one is damaged, or saving was cut short")
        return header, load_file(file)
    except (OSError, SafetensorError, TypeError, AttributeError) as error:
        raise ModelError(f"{file} is missing or damaged: {error}") from None


@contextmanager
def damaged_is_an_error(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Turn what a header or arrays of the wrong form set off while an object is rebuilt into a `ModelError`."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise ModelError(f"{folder} is damaged: {type(error).__name__} {error}") from None


def part(arrays: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """Return the arrays whose names begin with ``name.``, without that prefix."""
    return {key.removeprefix(f"{name}."): array for key, array in arrays.items() if key.startswith(f"{name}.")}


def saved_config(header: Mapping[str, Any], folder: str | os.PathLike[str]) -> Config:
    """Return the configuration that a header holds; a trained or exported network is the one in `folder`."""
    with damaged_is_an_error(folder):
        config = Config.from_dict(header["config"])
        if config.features.weights in _CARRIED:
            config = config.with_settings({"features.weights": str(Path(folder).resolve() / config.features.weights)})
        return config


def carry_weights(config: Config, folder: str | os.PathLike[str]) -> Config:
    """Copy a trained or exported network into `folder`, if there is one; return the configuration that names it so."""
    source, target = Path(config.features.weights), Path(folder)
    if source.name not in _CARRIED:
        return config
    if source.parent.resolve() != target.resolve():
        target.mkdir(parents=True, exist_ok=True)
        for name in _CARRIED[source.name]:
            part = target / f"{name}.part"
            shutil.copyfile(source.with_name(name), part)
            os.replace(part, target / name)
    return config.with_settings({"features.weights": source.name})


def agreed_config(
    config: Config | None, header: Mapping[str, Any] | None, folder: str | os.PathLike[str] | None = None
) -> Config:
    """Return the configuration, which must not contradict a model on anything that the model was fitted for.

    Parameters
    ----------
    config : Config, optional
        What is wanted; by default what the model was fitted with.
    header : mapping, optional
        Of the model; without one everything can be wanted.
    folder : path, optional
        Where the model is, for its own network and for what an error says.

    Raises
    ------
    ModelError
        If it contradicts the model.
    """
    if header is None:
        return config or Config()
    fitted = saved_config(header, folder or "the model")
    if config is None:
        return fitted
    wanted, found = config.flat(), fitted.flat()
    binding = [name for name in wanted if not name.startswith(_FREE)]
    if fitted.compression.reading == "sequence":
        binding.append("sequence.length")
    for name in binding:
        if wanted[name] != found[name]:
            raise ModelError(
                f"the model was fitted with {name} = {found[name]}, wanted {wanted[name]}; "
                "leave that setting out or fit again with it"
            )
    if config.aggregation.whitened != fitted.aggregation.whitened:
        raise ModelError(
            f"the model was fitted with aggregation.centre_window = {fitted.aggregation.centre_window}, wanted "
            f"{config.aggregation.centre_window}: descriptors are whitened in one of the two only; fit again with it"
        )
    return config
