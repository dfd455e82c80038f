"""What is learned is saved as arrays plus a JSON header; nothing that is loaded can run code."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from loopclosure.errors import ModelError

FORMAT = 1
HEADER, ARRAYS = "header.json", "arrays.safetensors"
MAX_HEADER_BYTES = 1 << 20


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
    part = path / f"{ARRAYS}.part"
    save_file({name: np.asarray(array, order="C") for name, array in arrays.items()}, part)
    os.replace(part, path / ARRAYS)
    part = path / f"{HEADER}.part"
    part.write_text(json.dumps({"format": FORMAT, "kind": kind, **header}, indent=2) + "\n", encoding="utf-8")
    os.replace(part, path / HEADER)
    return path


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
    path = Path(folder)
    if not (path / HEADER).is_file():
        raise ModelError(f"{path} holds no {HEADER}: it is not a folder that loopclosure saved")
    if (path / HEADER).stat().st_size > MAX_HEADER_BYTES:
        raise ModelError(f"{path / HEADER} is larger than {MAX_HEADER_BYTES} bytes: it is not ours or is damaged")
    try:
        header = json.loads((path / HEADER).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ModelError(f"{path / HEADER} is not readable JSON: {error}") from None
    if not isinstance(header, dict) or header.get("kind") != kind:
        found = header.get("kind") if isinstance(header, dict) else type(header).__name__
        raise ModelError(f"{path} holds '{found}', wanted '{kind}'")
    if header.get("format") != FORMAT:
        raise ModelError(
            f"{path} has format {header.get('format')}, this version reads format {FORMAT}; make it again with `fit`"
        )
    try:
        return header, load_file(path / ARRAYS)
    except (OSError, SafetensorError) as error:
        raise ModelError(f"{path / ARRAYS} is missing or damaged: {error}") from None


def part(arrays: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """Return the arrays whose names begin with ``name.``, without that prefix."""
    return {key.removeprefix(f"{name}."): array for key, array in arrays.items() if key.startswith(f"{name}.")}
