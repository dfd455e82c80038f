"""Checkpoints: one file of plain tensors with a JSON header, there only when it is whole; the one before it stays."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from loopclosure.errors import ModelError

FORMAT = 2
CHECKPOINT, BEFORE = "checkpoint.safetensors", "checkpoint.before.safetensors"
MAX_BYTES = 8 << 30


def has_checkpoint(folder: Path) -> bool:
    """Return whether a training was begun in `folder`."""
    return any((folder / name).exists() for name in (CHECKPOINT, BEFORE))


def expect(folder: Path, *, resume: bool) -> None:
    """Check that there is a checkpoint to resume from, or none that a new training would run over.

    Raises
    ------
    ModelError
        If it is the other way round.
    """
    if resume and not has_checkpoint(folder):
        raise ModelError(f"{folder} holds no checkpoint: nothing to resume; leave --resume out to begin")
    if not resume and has_checkpoint(folder):
        raise ModelError(f"{folder} holds a training that was begun; resume it, or name another folder")


def save_checkpoint(folder: Path, header: Mapping[str, Any], tensors: Mapping[str, torch.Tensor]) -> None:
    """Write a checkpoint; the last one becomes the one before.

    Parameters
    ----------
    folder : pathlib.Path
        Made if it is absent.
    header : mapping
        Anything that JSON can hold.
    tensors : mapping of str to Tensor
    """
    folder.mkdir(parents=True, exist_ok=True)
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    text = json.dumps({"format": FORMAT, "sha256": _digest(plain), "header": dict(header)})
    part = folder / f"{CHECKPOINT}.part"
    save_file(plain, part, metadata={"loopclosure": text})
    if (folder / CHECKPOINT).exists():
        os.replace(folder / CHECKPOINT, folder / BEFORE)
    os.replace(part, folder / CHECKPOINT)


def load_checkpoint(folder: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Read the last checkpoint of a training.

    Raises
    ------
    ModelError
        If there is none, or it is damaged; the message names the one before it.
    """
    expect(folder, resume=True)
    last, before = folder / CHECKPOINT, folder / BEFORE
    file = last if last.exists() else before
    try:
        return _read(file)
    except Exception as error:  # noqa: BLE001 - a damaged file can raise anything
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        way_out = f"; delete it to resume from {before.name}" if file == last and before.exists() else ""
        raise ModelError(f"the checkpoint {file} is damaged ({reason}){way_out}") from None


def _read(file: Path) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    if file.stat().st_size > MAX_BYTES:
        raise ValueError(f"larger than {MAX_BYTES} bytes")
    with safe_open(file, framework="pt") as content:
        text = json.loads(content.metadata()["loopclosure"])
        tensors = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118  (it is no dict)
    if text["format"] != FORMAT:
        raise ValueError(f"format {text['format']}, this version reads {FORMAT}")
    if text["sha256"] != _digest(tensors):
        raise ValueError("its numbers are not those that were written")
    return text["header"], tensors


def _digest(tensors: Mapping[str, torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for name in sorted(tensors):
        digest.update(name.encode())
        digest.update(tensors[name].numpy().tobytes())
    return digest.hexdigest()
