"""Take out what all recent frames have in common: the light, the season, the camera.

Appearance alone pulls a night frame to other night frames. Each traverse has a mean descriptor of its own; without it
two traverses of one place become comparable.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from loopclosure.aggregation.netvlad import unit


def centre_traverse(descriptors: np.ndarray, *, window: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Take the mean out of a traverse that is known as a whole.

    Parameters
    ----------
    descriptors : ndarray of float32, shape (n, d)
        Zero rows (blank frames) are not counted and stay zero.
    window : int
        With 0 nothing is taken out, as in `RunningMean`.

    Returns
    -------
    centred : ndarray of float32, shape (n, d)
        Unit rows.
    mean : ndarray of float32, shape (d,), or None
        What was taken out.
    """
    counted = descriptors.reshape(len(descriptors), -1).any(1)
    if window == 0 or not counted.any():
        return descriptors, None
    mean = descriptors[counted].mean(0, dtype=np.float64).astype(np.float32)
    centred = np.zeros_like(descriptors)
    centred[counted] = _left_over(descriptors[counted], mean)
    return centred, mean


_NOTHING = 1e-3  # of a descriptor's length: a frame that is all that recent frames share leaves rounding errors


def _left_over(descriptors: np.ndarray, mean: np.ndarray) -> np.ndarray:
    left = descriptors - mean
    lengths = [np.linalg.norm(vectors, axis=-1, keepdims=True) for vectors in (left, descriptors)]
    return unit(np.where(lengths[0] > _NOTHING * lengths[1], left, 0))


_PRIOR_FRAMES = 20  # the prior weighs as much as this many frames still missing


class RunningMean:
    """Mean descriptor of the last `window` frames of one traverse.

    Parameters
    ----------
    window : int
        Frames that count; with 0 nothing is taken out.
    prior : ndarray of float32, shape (d,), optional
        Stands in for the frames that are missing while fewer than 20 were seen: a mean over two or three frames would
        take out the place itself.
    """

    def __init__(self, window: int, *, prior: np.ndarray | None = None) -> None:
        self.window = window
        self.prior = prior
        self._recent: deque[np.ndarray] = deque(maxlen=max(window, 1))
        self._sum: np.ndarray | None = None

    def centre(self, descriptor: np.ndarray) -> np.ndarray:
        """Count one descriptor in, take the mean out of it, scale to length 1.

        Parameters
        ----------
        descriptor : ndarray of float32, shape (d,)
            Zeros (a blank frame) are passed through and not counted.

        Returns
        -------
        ndarray of float32, shape (d,)
        """
        if self.window == 0 or not descriptor.any():
            return descriptor
        if self._sum is None:
            self._sum = np.zeros(descriptor.shape)
        if len(self._recent) == self.window:
            self._sum -= self._recent[0]
        self._recent.append(descriptor)
        self._sum += descriptor
        return _left_over(descriptor, self._mean(self._sum).astype(np.float32))

    def _mean(self, total: np.ndarray) -> np.ndarray:
        missing = min(_PRIOR_FRAMES, self.window) - len(self._recent)
        if self.prior is None or missing <= 0:
            return total / len(self._recent)
        return (total + missing * self.prior) / (len(self._recent) + missing)

    @property
    def current(self) -> np.ndarray | None:
        """The mean as it now stands, shape (d,); the prior before the first frame."""
        return self.prior if self._sum is None else self._mean(self._sum).astype(np.float32)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        arrays = {"window": np.array(self.window)} | ({} if self.prior is None else {"prior": self.prior})
        if self._sum is None:
            return arrays
        return arrays | {"recent": np.stack(self._recent), "sum": self._sum.copy()}  # as it was rounded

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> RunningMean:
        """Rebuild the state that `to_arrays` gave."""
        mean = cls(int(arrays["window"]), prior=arrays.get("prior"))
        mean._recent.extend(arrays.get("recent", ()))
        mean._sum = arrays["sum"].copy() if "sum" in arrays else None
        return mean
