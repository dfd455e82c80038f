"""Distance between image sequences (paper 2.3, Eq. 20), one frame at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np


class SequenceScores:
    """Mean similarity of the last l frames to every historical window of l frames.

    ``score[j] = 1 - D = mean_i s[t - i, j - i]``, i = 0 .. l - 1: the current window ends at frame t, the historical
    one at the candidate j. A new frame costs one addition and one subtraction a candidate, whatever l is.

    Parameters
    ----------
    length : int
        Frames l in a sequence.
    exclude_recent : int
        In one stream, frames nearer than this are no candidates, and neither is a window that reaches into that band;
        0 for candidates from another traverse.
    both_directions : bool
        Also match windows that were driven the other way, along the anti-diagonal ``s[t - i, j + i]``; the candidate
        is the frame where the current one is now.
    history : int, optional
        Frames that must stand behind the current frame and behind a candidate; ``length`` by default. Larger where
        one similarity already speaks for several frames.

    Notes
    -----
    Rows may grow: in one stream row t has t entries, against another traverse all rows have the same length. The sums
    are kept in float64, in which sums of float32 similarities do not drift.

    Examples
    --------
    >>> scores = SequenceScores(2)
    >>> scores.push(np.array([1, 0, 0], np.float32))
    array([nan, nan, nan], dtype=float32)
    >>> scores.push(np.array([0, 1, 0], np.float32))
    array([nan,  1.,  0.], dtype=float32)
    """

    def __init__(
        self, length: int, *, exclude_recent: int = 0, both_directions: bool = False, history: int | None = None
    ) -> None:
        self.length = length
        self.exclude_recent = exclude_recent
        self.both_directions = both_directions
        self.history = history or length
        self.frames = 0
        self._rows: deque[np.ndarray] = deque(maxlen=length)
        self._forward = self._backward = np.zeros(0)

    def push(self, similarities: np.ndarray) -> np.ndarray:
        """Take the row of a new frame and return its sequence scores.

        Parameters
        ----------
        similarities : ndarray of float32, shape (n,)
            Of the new frame to each frame of the map, larger = more alike.

        Returns
        -------
        ndarray of float32, shape (n,)
            Larger = more alike; NaN where j is no candidate.
        """
        row = np.asarray(similarities, np.float32)
        expired = self._rows[0] if len(self._rows) == self.length else row[:0]
        self._rows.append(row)
        self.frames += 1
        self._forward = _step_forward(row, self._forward, expired, self.length)
        if self.both_directions:
            self._backward = _step_backward(row, self._backward, expired, self.length)
        return self._candidates(row.size)

    def _candidates(self, n: int) -> np.ndarray:
        scores = np.full(n, np.nan, np.float32)
        if self.frames < self.history:
            return scores
        newest = max(n - max(self.exclude_recent, 1), -1)
        forward = slice(self.history - 1, newest + 1)
        scores[forward] = self._forward[forward] / self.length
        if self.both_directions:
            reach = self.length - 1
            if self.exclude_recent:  # the two windows of one stream must not overlap either
                newest = min(newest, n - 1 - reach)
            backward = slice(0, max(newest - reach + 1, 0))
            scores[backward] = np.fmax(scores[backward], (self._backward[backward] / self.length).astype(np.float32))
        return scores

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        rows = {f"row{i}": row for i, row in enumerate(self._rows)}
        return {"frames": np.array(self.frames), "forward": self._forward, "backward": self._backward, **rows}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> SequenceScores:
        """Take over the state that `to_arrays` gave."""
        self.frames = int(arrays["frames"])
        self._forward, self._backward = arrays["forward"], arrays["backward"]
        self._rows.extend(arrays[f"row{i}"] for i in range(min(self.frames, self.length)))
        return self


def _step_forward(row: np.ndarray, sums: np.ndarray, expired: np.ndarray, length: int) -> np.ndarray:
    """``new[j] = old[j - 1] + row[j] - expired[j - length]``."""
    new = row.astype(np.float64)
    sums, expired = sums[: new.size - 1], expired[: max(new.size - length, 0)]
    new[1 : 1 + sums.size] += sums
    new[length : length + expired.size] -= expired
    return new


def _step_backward(row: np.ndarray, sums: np.ndarray, expired: np.ndarray, length: int) -> np.ndarray:
    """``new[j] = old[j + 1] + row[j] - expired[j + length]``."""
    new = row.astype(np.float64)
    new[: max(sums.size - 1, 0)] += sums[1:]
    new[: max(expired.size - length, 0)] -= expired[length:]
    return new
