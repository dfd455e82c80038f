"""Local features of two frames to pairs of points."""

from __future__ import annotations

import numpy as np

from loopclosure.verification.local_features import LocalFeatures


def mutual_matches(query: LocalFeatures, match: LocalFeatures, *, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Pair features that are each other's nearest, and say which of them stand out.

    Parameters
    ----------
    query, match : LocalFeatures
        Of one kind.
    ratio : float
        What stands out is nearer than `ratio` times the second nearest (Lowe 2004, Sec. 7.1).

    Returns
    -------
    pairs : ndarray of int64, shape (n, 2)
        Rows of `query` and of `match`, rising in the first.
    distinct : ndarray of bool, shape (n,)
    """
    if min(len(query), len(match)) < 2:
        return np.zeros((0, 2), np.int64), np.zeros(0, bool)
    squared = _squared_distances(query.vectors(), match.vectors())
    nearest, back = squared.argmin(axis=1), squared.argmin(axis=0)
    mutual = np.flatnonzero(back[nearest] == np.arange(len(query)))
    first, second = np.partition(squared[mutual], 1, axis=1)[:, :2].T
    return np.stack([mutual, nearest[mutual]], axis=1), first < ratio**2 * second


def _squared_distances(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return (n, m) squared Euclidean distances; exact, because the entries are whole numbers up to 255."""
    lengths = (left**2).sum(axis=1)[:, None] + (right**2).sum(axis=1)
    distances: np.ndarray = lengths - 2 * left @ right.T
    return distances
