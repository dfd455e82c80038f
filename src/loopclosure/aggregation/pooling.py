"""Means of feature maps over a few large cells: the plainest way from many local vectors to one."""

from __future__ import annotations

import numpy as np


def pool_cells(maps: np.ndarray, cells: int = 3) -> np.ndarray:
    """Average feature maps over a grid of cells.

    Cell i of an axis of n positions covers the positions from ``floor(i n / cells)`` to ``ceil((i + 1) n / cells)``,
    so that neighbours may share some of them (adaptive average pooling).

    Parameters
    ----------
    maps : ndarray of float32, shape (n, h, w, c)
    cells : int
        Cells along each axis; 1 pools the whole map.

    Returns
    -------
    ndarray of float32, shape (n, cells * cells, c)
        Row by row from the upper left.

    Examples
    --------
    >>> pool_cells(np.arange(16, dtype=np.float32).reshape(1, 4, 4, 1), cells=2)[0, :, 0]
    array([ 2.5,  4.5, 10.5, 12.5], dtype=float32)
    """
    rows, columns = (_spans(size, cells) for size in maps.shape[1:3])
    means = [maps[:, row, column].mean(axis=(1, 2)) for row in rows for column in columns]
    return np.stack(means, axis=1)


def _spans(size: int, cells: int) -> list[slice]:
    return [slice(i * size // cells, -(-(i + 1) * size // cells)) for i in range(cells)]
