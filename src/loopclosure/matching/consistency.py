"""Do the best candidates move on with the robot? A place that is really seen again is followed by its neighbours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

_LARGEST_STEP = 3  # frames of the map that a match may move while the robot moves by one
_MEMORY = 0.95  # what a frame of a run counts, to the frame behind it


class Followed(NamedTuple):
    """What lies behind a candidate.

    Attributes
    ----------
    run : int
        Frames over which it has moved on steadily, those alone in which something was said for it.
    lasting : float
        Mean of what was said for it while it moved on, in the other frames too, older ones counting less; what came
        before counts as zero.
    """

    run: int
    lasting: float


class Consistency:
    """Follow candidates from frame to frame.

    From one frame to the next a candidate may stay or move by up to three frames, always the same way: forward, or
    backward where `both_directions` is asked. A moving thing that follows the robot, or two streets that look alike,
    rarely keeps that up. Where it is told what speaks for a candidate, only frames count in which that is more than
    nothing: among few places even chance keeps one near the best for long.

    Examples
    --------
    >>> consistency = Consistency()
    >>> [[one.run for one in consistency.push(matches)] for matches in ([10], [11, 70], [13, 71], [40], [], [42])]
    [[1], [2, 1], [3, 2], [1], [], [1]]
    """

    def __init__(self, *, both_directions: bool = False) -> None:
        self._signs = (1, -1) if both_directions else (1,)
        self._matches = np.zeros(0, np.int64)
        self._runs = np.zeros((len(self._signs), 0), np.int64)
        self._lasting = np.zeros((len(self._signs), 0))

    def push(self, matches: Sequence[int], values: Sequence[float] | None = None) -> list[Followed]:
        """Take the candidates of a new frame, and what is said for each of them; return what lies behind each."""
        count, before = len(matches), len(self._matches)
        told = np.array(values if values is not None else np.zeros(count))
        runs, lasting = np.zeros((len(self._signs), count), np.int64), np.zeros((len(self._signs), count))
        steps = np.array(matches, np.int64)[:, None] - self._matches
        for way, sign in enumerate(self._signs):
            follows = (sign * steps >= 0) & (sign * steps <= _LARGEST_STEP)
            if before and count:
                longest = np.where(follows, self._runs[way], -1).argmax(axis=1)
                goes_on = follows.any(axis=1)
                runs[way] = np.where(goes_on, self._runs[way][longest], 0)
                lasting[way] = np.where(goes_on, self._lasting[way][longest], 0)
        runs += told > 0 if values is not None else 1
        lasting = _MEMORY * lasting + (1 - _MEMORY) * told
        self._matches, self._runs, self._lasting = np.array(matches, np.int64), runs, lasting
        best = runs.argmax(axis=0)
        return [Followed(int(runs[way, i]), float(lasting[way, i])) for i, way in enumerate(best)]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        return {"matches": self._matches, "runs": self._runs, "lasting": self._lasting}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Consistency:
        """Take over the state that `to_arrays` gave."""
        self._matches, self._runs, self._lasting = (arrays[name] for name in ("matches", "runs", "lasting"))
        return self
