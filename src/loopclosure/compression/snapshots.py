"""Linear algebra of few but very long rows, some columns at a time, so that no float64 copy of the whole exists."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from loopclosure.compression.spectrum import fix_signs

CHUNK_BYTES = 32 << 20

Columns = Callable[[slice], NDArray[np.float64]]
"""Gives some columns of a tall stack of rows in float64, so that the whole need not exist in float64."""


def _columns(rows: int, width: int) -> Iterator[slice]:
    step = max(1, CHUNK_BYTES // (8 * rows))
    return (slice(start, start + step) for start in range(0, width, step))


def gram(stack: Columns, rows: int, width: int) -> NDArray[np.float64]:
    """Return the product of a tall stack with its transpose (Eq. 10 without its 1/m)."""
    product = np.zeros((rows, rows))
    for columns in _columns(rows, width):
        block = stack(columns)
        product += block @ block.T
    return product


def orthonormal_rows(stack: Columns, weights: NDArray[np.float64], count: int, width: int) -> NDArray[np.float32]:
    """Return ``weights @ stack`` as `count` orthonormal rows; missing ones are arbitrary but always the same."""
    found, rows = weights.shape
    basis = np.empty((count, width), np.float32)
    if found:
        for columns in _columns(rows, width):
            basis[:found, columns] = weights @ stack(columns)
    if count:
        basis[found:] = np.random.default_rng(0).standard_normal((count - found, width), np.float32) / np.sqrt(width)
        _orthonormalise(basis)
        fix_signs(basis)
    return basis


def _orthonormalise(basis: NDArray[np.float32]) -> None:
    """Make rows orthonormal in place, each by what the rows above it leave (Gram-Schmidt by Cholesky).

    The small problem has the square of the condition of the large one, so that its weak eigenvectors are not quite
    orthogonal to the strong ones; the strong ones, which come first, stay as they are.
    """
    count, width = basis.shape
    lower = np.linalg.cholesky(gram(lambda columns: basis[:, columns].astype(np.float64), count, width))
    for columns in _columns(count, width):
        basis[:, columns] = solve_triangular(lower, basis[:, columns].astype(np.float64), lower=True)
