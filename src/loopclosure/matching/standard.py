"""Similarities counted from the mean of a frame's candidates."""

from __future__ import annotations

import numpy as np

from loopclosure.matching.sequences import SequenceScores

_LEAST_SPREAD = 1e-4  # of cosines, L1 scores or log-odds; below it they differ by rounding


class StandardScores(SequenceScores):
    """`SequenceScores` of similarities in standard deviations, see `standard_deviations`.

    Examples
    --------
    >>> StandardScores(1).push(np.array([0.5, 0.5, 0.8])).round(2)
    array([-0.71, -0.71,  1.41], dtype=float32)
    """

    def push(self, similarities: np.ndarray) -> np.ndarray:
        """Take the row of a new frame, float32 (n,), and return its sequence scores, NaN where there is no candidate.

        A row that is the same everywhere counts as zeros.
        """
        candidates = max(len(similarities) - max(self.exclude_recent - 1, 0), 0)
        return super().push(standard_deviations(similarities, candidates))


def standard_deviations(similarities: np.ndarray, candidates: int) -> np.ndarray:
    """Return similarities in standard deviations from the mean of the first `candidates` of them.

    How alike two images of one place are depends on the scene; how far they stand out among others, less so.

    Parameters
    ----------
    similarities : ndarray of float, shape (n,)
    candidates : int
        Frames that can be matched, 0..n.

    Returns
    -------
    ndarray of float64, shape (n,)
        Zeros where the candidates are all alike, or none.

    Examples
    --------
    >>> standard_deviations(np.array([1.0, 3.0, 4.0]), 2).tolist()
    [-1.0, 1.0, 2.0]
    """
    row = np.asarray(similarities, np.float64)
    known = row[:candidates]
    spread = known.std() if candidates else 0.0
    return (row - known.mean()) / spread if spread > _LEAST_SPREAD else np.zeros(len(row))
