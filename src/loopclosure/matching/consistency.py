"""Does the best candidate move on with the robot? A place that is really seen again is followed by its neighbours."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

_LARGEST_STEP = 3  # frames of the map that the match may move while the robot moves by one


class Consistency:
    """Count the frames over which the best candidate has moved on steadily.

    From one frame to the next the match may stay or move by up to three frames, always the same way: forward, or
    backward where `both_directions` is asked. A moving thing that follows the robot, or two streets that look alike,
    rarely keeps that up.

    Examples
    --------
    >>> consistency = Consistency()
    >>> [consistency.push(match) for match in (10, 11, 13, 40, 41, None, 42)]
    [1, 2, 3, 1, 2, 0, 1]
    """

    def __init__(self, *, both_directions: bool = False) -> None:
        self._both = both_directions
        self._previous = -1
        self._forward = self._backward = 0

    def push(self, match: int | None) -> int:
        """Take the best candidate of a new frame, None where there is none; return the length of its run, frames."""
        if match is None:
            self._forward = self._backward = 0
            return 0
        step = match - self._previous
        self._forward = self._forward + 1 if self._forward and 0 <= step <= _LARGEST_STEP else 1
        self._backward = self._backward + 1 if self._backward and -_LARGEST_STEP <= step <= 0 else 1
        self._previous = match
        return max(self._forward, self._backward) if self._both else self._forward

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        return {"state": np.array([self._previous, self._forward, self._backward])}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Consistency:
        """Take over the state that `to_arrays` gave."""
        self._previous, self._forward, self._backward = map(int, arrays["state"])
        return self
