"""Do the best candidates move on with the robot? A place that is really seen again is followed by its neighbours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

_LARGEST_STEP = 3  # frames of the map that a match may move while the robot moves by one


class Consistency:
    """Count the frames over which each candidate has moved on steadily.

    From one frame to the next a candidate may stay or move by up to three frames, always the same way: forward, or
    backward where `both_directions` is asked. A moving thing that follows the robot, or two streets that look alike,
    rarely keeps that up.

    Examples
    --------
    >>> consistency = Consistency()
    >>> [consistency.push(matches) for matches in ([10], [11, 70], [13, 71], [40], [], [42])]
    [[1], [2, 1], [3, 2], [1], [], [1]]
    """

    def __init__(self, *, both_directions: bool = False) -> None:
        self._both = both_directions
        self._previous = np.zeros((0, 3), np.int64)  # match, frames forward, frames backward

    def push(self, matches: Sequence[int]) -> list[int]:
        """Take the candidates of a new frame; return the length of the run of each, frames."""
        current = np.ones((len(matches), 3), np.int64)
        current[:, 0] = matches
        steps = current[:, :1] - self._previous[:, 0]
        for column, sign in ((1, 1), (2, -1)):
            follows = (sign * steps >= 0) & (sign * steps <= _LARGEST_STEP)
            current[:, column] += np.where(follows, self._previous[:, column], 0).max(axis=1, initial=0)
        self._previous = current
        return current[:, 1:].max(axis=1).tolist() if self._both else current[:, 1].tolist()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        return {"previous": self._previous}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Consistency:
        """Take over the state that `to_arrays` gave."""
        self._previous = arrays["previous"]
        return self
