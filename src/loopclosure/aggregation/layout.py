"""What is where in the view: beside NetVLAD, which sees the same words wherever they stand.

NetVLAD finds a place again when the camera has moved; where the camera goes the same way and only light, season or
traffic change, the layout of the view tells more (a train, a robot in its lane). Side by side the two do better than
each of them alone.
"""

from __future__ import annotations

import numpy as np

from loopclosure.aggregation.netvlad import unit

_JOINED = 2  # columns of a map: a robot comes back a little to the side more often than higher or lower


def layout(maps: np.ndarray) -> np.ndarray:
    """Return each map as one vector, neighbouring columns joined.

    Parameters
    ----------
    maps : ndarray of float32, shape (n, h, w, c)

    Returns
    -------
    ndarray of float32, shape (n, h * ceil(w / 2) * c)
        Unit rows; zeros for a blank image.

    Examples
    --------
    >>> layout(np.array([[[1, 3, 4], [0, 0, 2]]], np.float32)[..., None]).round(3)
    array([[0.408, 0.816, 0.   , 0.408]], dtype=float32)
    """
    starts = np.arange(0, maps.shape[2], _JOINED)
    joined = np.add.reduceat(maps, starts, axis=2) / np.minimum(_JOINED, maps.shape[2] - starts)[:, None]
    return unit(joined.reshape(len(maps), -1).astype(np.float32))
