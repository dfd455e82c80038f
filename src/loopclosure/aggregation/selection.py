"""Choose how much to compress from the images alone: neighbours in time are one place, far ones mostly are not."""

from __future__ import annotations

import numpy as np

GAMMAS = (0.0, 0.3, 0.6, 0.8, 0.9)
"""Compression ratios (Eq. 16) that are tried."""

_NEAR = 2, 4  # frames: the nearest one would be alike whatever is compared
_FAR_SHARE, _FAR_LEAST = 0.25, 10  # of the drive, frames


def margin(descriptors: np.ndarray) -> float:
    """Return by how much the neighbours of a frame are more alike than the most alike of all far frames, on average.

    No truth is asked. A drive that returns to a place within its first frames lowers the margin of every setting alike.

    Parameters
    ----------
    descriptors : ndarray of float32, shape (n, d)
        Unit rows of frames in the order of the drive.

    Returns
    -------
    float
        A difference of cosines, larger = places are told apart better; -inf where no frame has a far one.

    Examples
    --------
    >>> margin(np.eye(30, dtype=np.float32))
    0.0
    """
    near, far = [], []
    apart = max(int(_FAR_SHARE * len(descriptors)), _FAR_LEAST)
    cosines = descriptors @ descriptors.T
    for frame, row in enumerate(cosines):
        away = np.abs(np.arange(len(row)) - frame)
        if (away >= apart).any():
            near.append(row[(away >= _NEAR[0]) & (away <= _NEAR[1])].mean())
            far.append(row[away >= apart].max())
    return float(np.mean(np.subtract(near, far))) if near else -np.inf
