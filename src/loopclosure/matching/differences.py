"""Thumbnails to differences between queries and references, and their contrast along the references (SeqSLAM).

Source: Milford and Wyeth, ICRA 2012; the public implementation OpenSeqSLAM (2013), whose matrices D and DD are the
transposes of those here: rows are queries.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.distance import cdist

from loopclosure.errors import ConfigError, ModelError

_REFERENCES = 64  # so many stay in the processor's cache while they are compared
_NUMBERS = 1 << 22  # in a temporary array


def difference_matrix(queries: np.ndarray, references: np.ndarray) -> np.ndarray:
    """Return the sum of absolute differences of every query and reference, divided by the number of references.

    That divisor is OpenSeqSLAM's.

    Parameters
    ----------
    queries : ndarray of float32 or uint8, shape (n_queries, height, width)
    references : ndarray of float32 or uint8, shape (n_references, height, width)

    Returns
    -------
    ndarray of float32, shape (n_queries, n_references)
        0 for equal thumbnails.

    Raises
    ------
    ModelError
        If queries and references differ in size.

    Examples
    --------
    >>> difference_matrix(np.array([[[0, 3]]], np.uint8), np.array([[[1, 1]], [[0, 3]]], np.uint8)).tolist()
    [[1.5, 0.0]]
    """
    _check_sizes(queries.shape[1:], references.shape[1:])
    sums = cdist(_flat(queries), _flat(references), "cityblock")
    return (sums / max(len(references), 1)).astype(np.float32)


def difference_row(query: np.ndarray, references: np.ndarray) -> np.ndarray:
    """Return one row of `difference_matrix`, the way an online search needs it.

    Parameters
    ----------
    query : ndarray of float32 or uint8, shape (height, width)
    references : ndarray of float32 or uint8, shape (n_references, height, width)

    Returns
    -------
    ndarray of float32, shape (n_references,)
    """
    _check_sizes(query.shape, references.shape[1:])
    query = query.astype(np.float32)  # uint8 differences would wrap round
    row = np.empty(len(references), np.float32)
    for start in range(0, len(references), _REFERENCES):
        block = slice(start, start + _REFERENCES)
        row[block] = np.abs(references[block] - query).sum(axis=(1, 2))
    return row / np.float32(max(len(references), 1))


def enhance_contrast(differences: np.ndarray, radius: int = 5) -> np.ndarray:
    """Normalise every difference within its neighbourhood along the references, over a whole matrix.

    Mean and standard deviation (with n - 1) are taken over at most ``2 * radius + 1`` neighbours, fewer at the ends;
    then the least value of the matrix is subtracted. Deviation from OpenSeqSLAM: a neighbourhood without contrast,
    where it divides by zero, gives 0 before that.

    Parameters
    ----------
    differences : ndarray of float, shape (n_queries, n_references)
    radius : int
        Neighbours on each side, references; at least 1.

    Returns
    -------
    ndarray of float32, shape (n_queries, n_references)
        Not negative; smaller = more alike.
    """
    contrast = _local_contrast(differences, radius)
    return contrast - contrast.min() if contrast.size else contrast


def enhance_row(differences: np.ndarray, radius: int = 5) -> np.ndarray:
    """Normalise every difference of one query within its neighbourhood, without knowing later queries.

    Deviation from OpenSeqSLAM: the least value of the whole matrix is not known before the drive has ended. In its
    place stands the least value that such a neighbourhood can have, ``-2 * radius / sqrt(2 * radius + 1)``, and the
    range is scaled to [0, 1].

    Parameters
    ----------
    differences : ndarray of float, shape (n_references,)
    radius : int
        Neighbours on each side, references; at least 1.

    Returns
    -------
    ndarray of float32, shape (n_references,)
        In [0, 1]; smaller = more alike, 0.5 = as the neighbours are on average.

    Examples
    --------
    >>> enhance_row(np.array([5.0, 1.0, 5.0]), radius=1).round(2)
    array([0.81, 0.  , 0.81], dtype=float32)
    """
    bound = 2 * radius / np.sqrt(2 * radius + 1)
    return np.clip(0.5 + _local_contrast(differences[None], radius)[0] / np.float32(2 * bound), 0, 1)


def _local_contrast(differences: np.ndarray, radius: int) -> np.ndarray:
    if radius < 1:
        raise ConfigError(f"found a contrast radius of {radius}, wanted at least 1 reference")
    contrast = np.zeros(differences.shape, np.float32)
    if contrast.size == 0:
        return contrast
    size = 2 * radius + 1
    inside = np.lib.stride_tricks.sliding_window_view(np.pad(np.ones(differences.shape[1]), radius), size)
    count = inside.sum(axis=1)
    step = max(1, _NUMBERS // inside.size)
    for start in range(0, len(differences), step):
        values = differences[start : start + step].astype(np.float64)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, ((0, 0), (radius, radius))), size, axis=1)
        mean = windows.sum(axis=2) / count
        squares = ((windows - mean[:, :, None]) ** 2 * inside).sum(axis=2)
        deviation = np.sqrt(squares / np.maximum(count - 1, 1))
        # Equal differences leave rounding errors here, which division would blow up to whole deviations.
        flat = deviation <= np.finfo(np.float32).eps * np.abs(mean)
        contrast[start : start + step] = np.where(flat, 0, values - mean) / np.where(flat, 1, deviation)
    return contrast


def _flat(images: np.ndarray) -> np.ndarray:
    return images.reshape(len(images), images.shape[1] * images.shape[2]).astype(np.float64)


def _check_sizes(queries: tuple[int, ...], references: tuple[int, ...]) -> None:
    if queries != references:
        raise ModelError(
            f"references are thumbnails of shape {references}, queries of {queries}; were they made alike?"
        )
