"""Bounds of truth files, and the one way to open them: files come from strangers."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from loopclosure.errors import TruthError

MAX_SIDE = 20_000
"""Most frames along either axis of a truth matrix."""
MAX_FRAMES = 1_000_000
"""Most frames of a sparse truth: a list of pairs, or poses."""
MAX_BYTES = 1 << 30
"""Most bytes of a matrix in memory, and about the most of a file."""
MAX_PAIRS = 30_000_000
"""Most true (or ignored) pairs."""
MAX_TEXT_BYTES = 1 << 28


def check_shape(file: Path, shape: tuple[int, ...], cell_bytes: int) -> tuple[int, int]:
    """Refuse what is no matrix or too large, before a cell of it is read."""
    if len(shape) != 2:
        raise TruthError(f"{file} holds an array of {len(shape)} dimensions {shape}, wanted a matrix of two")
    if min(shape) < 1:
        raise TruthError(f"{file} holds an empty matrix {shape}, wanted queries x references")
    if max(shape) > MAX_SIDE or shape[0] * shape[1] * cell_bytes > MAX_BYTES:
        raise TruthError(
            f"{file} holds a matrix of {shape[0]} x {shape[1]} cells of {cell_bytes} bytes, "
            f"wanted at most {MAX_SIDE} a side and {MAX_BYTES >> 20} MiB: give the truth as a list of pairs"
        )
    return shape[0], shape[1]


def check_count(file: Path, pairs: int) -> None:
    """Refuse a truth that would not fit into memory as pairs."""
    if pairs > MAX_PAIRS:
        raise TruthError(f"{file} holds {pairs} pairs, wanted at most {MAX_PAIRS}: is it a truth of places?")


def digest(file: Path) -> str:
    """Return the SHA-256 of the file in hexadecimal digits."""
    sha = hashlib.sha256()
    try:
        if not file.is_file() and file.exists():
            raise TruthError(f"cannot read the truth {file}: it is not a file")
        if file.stat().st_size > MAX_BYTES + 4096:
            raise TruthError(f"{file} is larger than {MAX_BYTES >> 20} MiB: it is no truth")
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                sha.update(block)
    except OSError as error:
        raise TruthError(f"cannot read the truth {file}: {error.strerror or error}") from None
    return sha.hexdigest()


def cells_as_pairs(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Stack two index vectors to int32 pairs (2, n)."""
    return np.stack([rows.astype(np.int32), columns.astype(np.int32)])
