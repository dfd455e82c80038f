"""k-means over float vectors and over packed bits."""

from __future__ import annotations

import numpy as np
from scipy import sparse

_CHUNK = 4096  # rows of a distance matrix that exist at one time
_MAX_SPREAD = 64  # k-means++ passes over all vectors once for each centre


def as_vectors(descriptors: np.ndarray) -> np.ndarray:
    """Return descriptors as float32 vectors; packed bits become -1 and +1.

    Of such vectors the squared Euclidean distance is four times the Hamming distance of the bits, so that one code
    serves both kinds.

    Parameters
    ----------
    descriptors : ndarray (n, d) of float, or (n, d) uint8 of packed bits

    Returns
    -------
    ndarray of float32, shape (n, d) or (n, 8 d)

    Examples
    --------
    >>> as_vectors(np.array([[0b10100000]], np.uint8)).astype(int)
    array([[ 1, -1,  1, -1, -1, -1, -1, -1]])
    """
    if descriptors.dtype == np.uint8:
        return np.unpackbits(descriptors, axis=1).astype(np.float32) * 2 - 1
    return np.asarray(descriptors, np.float32)


def nearest(vectors: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return for each vector the row of the nearest centre, Euclidean.

    Parameters
    ----------
    vectors : ndarray of float32, shape (n, d)
    centres : ndarray of float32, shape (k, d)

    Returns
    -------
    ndarray of int64, shape (n,)
    """
    half = np.square(centres).sum(1) / 2
    found = np.empty(len(vectors), np.int64)
    for start in range(0, len(vectors), _CHUNK):
        found[start : start + _CHUNK] = (vectors[start : start + _CHUNK] @ centres.T - half).argmax(1)
    return found


def lloyd(vectors: np.ndarray, centres: np.ndarray, *, iterations: int, binary: bool = False) -> np.ndarray:
    """Improve k-means centres; a centre that loses all its vectors stays where it was.

    Parameters
    ----------
    vectors : ndarray of float32, shape (n, d)
    centres : ndarray of float32, shape (k, d)
    iterations : int
        At most; it ends earlier when nothing changes.
    binary : bool
        Centres are majority votes (-1 or +1, ties +1) instead of means (k-majority, Grana et al. 2013).

    Returns
    -------
    ndarray of float32, shape (k, d)
    """
    before = None
    for _ in range(iterations):
        owner = nearest(vectors, centres)
        if before is not None and np.array_equal(owner, before):
            break
        before = owner
        members = sparse.csr_matrix(
            (np.ones(len(owner), np.float32), owner, np.arange(len(owner) + 1)), shape=(len(owner), len(centres))
        )
        count = np.bincount(owner, minlength=len(centres))
        total = np.asarray(members.T @ vectors)
        mean = np.where(total >= 0, 1, -1) if binary else total / np.maximum(count, 1)[:, None]
        centres = np.where(count[:, None] > 0, mean, centres).astype(np.float32)
    return centres


def spread_start(vectors: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    """Return k vectors to start from: k-means++ (Arthur & Vassilvitskii 2007) up to 64, random ones above."""
    if k > _MAX_SPREAD:
        return vectors[np.sort(rng.choice(len(vectors), k, replace=False))]
    chosen = [int(rng.integers(len(vectors)))]
    distance = np.square(vectors - vectors[chosen[0]]).sum(1)
    while len(chosen) < k and distance.any():
        reach = np.cumsum(distance, dtype=np.float64)
        chosen.append(int(np.searchsorted(reach, rng.random() * reach[-1], side="right")))
        distance = np.minimum(distance, np.square(vectors - vectors[chosen[-1]]).sum(1))
    return vectors[chosen]
