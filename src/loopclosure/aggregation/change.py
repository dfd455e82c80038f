"""Which parts of the view tell the place: those that change while the robot moves.

What rides along, a lorry ahead, the rim of a lens, the robot's own bonnet, stays where it is in the view, and so do sky
and road, which look alike everywhere. Walls and trees go by.
"""

from __future__ import annotations

import numpy as np

from loopclosure.aggregation.netvlad import unit

_USUAL = 0.75  # quantile of the changes in a view that counts in full: much of it may ride along
_SLIGHT = 0.1  # change, 1 - cosine, that noise makes too; where the view changes no more the robot stands, or nearly
_LEAST = 0.1  # weight


def change(newest: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Return what each position of a map counts, by how much it has changed since an earlier frame.

    Parameters
    ----------
    newest, before : ndarray of float32, shape (h, w, c)
        Feature maps of two frames of one drive.

    Returns
    -------
    ndarray of float32, shape (h, w)
        Weights, 0.1 to 1. The less the whole view changes, the nearer all of them are to 1: when the robot stands, what
        changes are passers-by.

    Examples
    --------
    >>> before = np.ones((1, 4, 2), np.float32)
    >>> newest = before * np.array([[1, 1], [1, 1], [-1, 1], [-1, 1]], np.float32)
    >>> change(newest, before).round(3)
    array([[0.1, 0.1, 1. , 1. ]], dtype=float32)
    """
    changes = 1 - (unit(newest) * unit(before)).sum(axis=-1)
    usual = max(float(np.quantile(changes, _USUAL)), 1e-30)
    moving = min(usual / _SLIGHT, 1)
    weights: np.ndarray = 1 - moving * (1 - np.clip(changes / usual, _LEAST, 1))
    return weights.astype(np.float32)
