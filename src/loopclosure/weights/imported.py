"""Records of imported weights: ``NAME.json`` beside ``NAME.safetensors`` in the cache."""

from __future__ import annotations

import json
import os
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

from loopclosure.errors import WeightsError
from loopclosure.weights.table import DEFAULTS, Weights

FORMAT = 1
MAX_RECORD_BYTES = 1 << 16
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_KEPT = ("backbone", "variant", "sha256", "size_mb", "licence", "source", "height", "width", "mean", "std")


def is_name(text: str) -> bool:
    """Return whether `text` can be the name of imported weights: 1 to 64 letters, digits, dots, dashes, underscores."""
    return _NAME.fullmatch(text) is not None


def imported_names(folder: Path) -> list[str]:
    """Return the names of the records in `folder`, in order; none if the folder does not exist."""
    return sorted(file.stem for file in folder.glob("*.json") if is_name(file.stem))


def tensors_file(folder: Path, name: str) -> Path:
    """Return where the tensors of the imported weights `name` lie."""
    return folder / f"{name}.safetensors"


def write_record(folder: Path, weights: Weights, *, source_sha256: str) -> None:
    """Write the record of `weights`; it appears only when it is whole.

    Parameters
    ----------
    folder : pathlib.Path
        The cache.
    weights : Weights
        Its `sha256` is that of the tensors as they lie in the cache.
    source_sha256 : str
        Digest of the file that was imported.
    """
    kept = {key: value for key, value in asdict(weights).items() if key in _KEPT}
    record = {"format": FORMAT, **kept, "channels": "RGB", "source_sha256": source_sha256}
    part = folder / f"{weights.name}.json.part"
    part.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    os.replace(part, folder / f"{weights.name}.json")


def read_record(folder: Path, name: str) -> Weights | None:
    """Return the imported weights `name`; None if there are none.

    Raises
    ------
    WeightsError
        If the record is damaged or of another format.
    """
    file = folder / f"{name}.json"
    if not is_name(name) or not file.is_file():
        return None
    try:
        with file.open(encoding="utf-8") as stream:
            return _from_json(folder, name, json.loads(stream.read(MAX_RECORD_BYTES)))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise WeightsError(
            f"{file} is damaged ({type(error).__name__}: {error}); delete it and import the weights again"
        ) from None


def _from_json(folder: Path, name: str, record: dict[str, Any]) -> Weights:
    if record["format"] != FORMAT or record["channels"] != "RGB":
        raise ValueError(f"format {record['format']}, {record['channels']}; this version reads {FORMAT}, RGB")
    if record["backbone"] not in DEFAULTS or len(record["sha256"]) != 64:
        raise ValueError("unknown backbone or no sha256")
    values = {key: record[key] for key in _KEPT}
    for key in ("mean", "std"):
        values[key] = tuple(float(value) for value in values[key])
        if len(values[key]) != 3:
            raise ValueError(f"{key} has {len(values[key])} values")
    return Weights(name=name, path=tensors_file(folder, name), **values)
