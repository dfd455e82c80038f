"""Which of a few neighbouring places the robot is at: told by more frames than those that found the neighbourhood."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

import numpy as np

from loopclosure.matching.index import PlaceIndex

FRAMES = 10
"""Frames that tell neighbours apart; more of them changed nothing on any of the sets that the odds were fitted on."""

_REACH = 5  # frames of the map; `best_candidates` sees no two candidates nearer than this
_FEWEST = 3  # frames that may overrule a sequence
_TIE = 1e-6  # of the cosine, a frame of distance: between equal places the candidate stays


class Trail:
    """The descriptors of the last frames, to be laid over the places around a candidate.

    The neighbour three frames on is nearly the same picture, so that a short sequence often ends there. Where the
    candidate has moved on with the robot for longer than the sequence is long, these earlier frames were of the same
    stretch, and the mean along the diagonal (Eq. 20) over all of them lies right far more often. The first places of a
    map have no whole sequence behind them and cannot be candidates: next to them, too, the trail decides, and it counts
    as many frames as the map has.

    Parameters
    ----------
    places : PlaceIndex
        The map.
    length : int
        Frames in a sequence; they have been compared already.
    exclude_recent : int
        In one stream, frames nearer than this are no candidates; 0 for another traverse.
    both_directions : bool
        Whether the stretch may also have been driven the other way.

    Examples
    --------
    >>> places = PlaceIndex()
    >>> for angle in np.linspace(0, 1, 20, dtype=np.float32):
    ...     places.add(np.array([np.cos(angle), np.sin(angle)]))
    >>> trail = Trail(places, length=1)
    >>> for descriptor in places.rows(np.arange(5, 15)):
    ...     trail.push(descriptor)
    >>> trail.nearest(12, frames=10)
    14
    """

    def __init__(
        self, places: PlaceIndex, *, length: int, exclude_recent: int = 0, both_directions: bool = False
    ) -> None:
        self._places = places
        self._length = length
        self._excluded = exclude_recent
        self._ways = (1, -1) if both_directions else (1,)
        self._recent: deque[np.ndarray] = deque(maxlen=FRAMES)

    def push(self, descriptor: np.ndarray) -> None:
        """Take the descriptor of a new frame, ndarray of float32 (d,), which a stream has put into the map."""
        self._recent.appendleft(descriptor)

    def nearest(self, match: int, frames: int) -> int:
        """Return the place around a candidate that the last frames fit best.

        Parameters
        ----------
        match : int
            The candidate.
        frames : int
            Frames over which it has moved on with the robot; no more than these are used.
        """
        cut_off = match < self._length + _REACH
        if min(frames, FRAMES) <= self._length and not cut_off:
            return match
        recent = np.stack(self._recent)[: max(frames, _FEWEST)]
        newest = len(self._places) - 1 - self._excluded
        near = np.arange(max(match - _REACH, 0), min(match + _REACH, newest) + 1)
        means = [self._fit(near, way, recent) for way in self._ways]
        return int(near[(np.max(means, axis=0) - _TIE * np.abs(near - match)).argmax()])

    def _fit(self, near: np.ndarray, way: int, recent: np.ndarray) -> np.ndarray:
        """Return the mean cosine of the frames with those on the track to each place, as far as the map goes."""
        ages = np.arange(len(recent))
        track = near[:, None] - way * ages
        newest = len(self._places) - 1
        last_candidate = newest - (self._excluded + ages if self._excluded else 0)  # as seen from each of the frames
        inside = (track >= 0) & (track <= last_candidate)
        cosines = np.einsum("cfd,fd->cf", self._places.rows(np.clip(track, 0, newest)), recent)
        mean: np.ndarray = (cosines * inside).sum(axis=1) / inside.sum(axis=1)
        return mean

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        return {"recent": np.stack(self._recent)} if self._recent else {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Trail:
        """Take over the state that `to_arrays` gave."""
        self._recent.extend(arrays.get("recent", ()))
        return self
