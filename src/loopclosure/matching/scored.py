"""What comparing a frame with the map gives: scores of all places, or of those on a shortlist."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Scored:
    """Sequence scores of one frame.

    Attributes
    ----------
    scores : ndarray of float32, shape (c,)
        Larger = more alike; NaN where a place is no candidate.
    ids : ndarray of int64, shape (c,), or None
        Places that these are the scores of, ascending; None = all of the map.
    usual : Scored or None
        Beside a shortlist: places that lie evenly spread over the map, whether they are like the frame or not. Their
        scores are what chance gives.
    places : int
        Beside a shortlist: places in the map.

    Examples
    --------
    >>> Scored(np.array([0.75, 0.5], np.float32), np.array([1, 3]), places=5).row()
    array([ nan, 0.75,  nan, 0.5 ,  nan], dtype=float32)
    """

    scores: np.ndarray
    ids: np.ndarray | None = None
    usual: Scored | None = None
    places: int = 0

    @classmethod
    def nothing(cls, places: int) -> Scored:
        """Return what an unreadable frame gives: no place is a candidate."""
        return cls(np.zeros(0, np.float32), np.zeros(0, np.int64), places=places)

    def row(self) -> np.ndarray:
        """Return one score for each place of the map, float32 (n,), NaN for those that are not on the shortlist."""
        if self.ids is None:
            return self.scores
        row = np.full(self.places, np.nan, np.float32)
        row[self.ids] = self.scores
        return row

    def place(self, at: int) -> int:
        """Return the place of a position in `scores`."""
        return at if self.ids is None else int(self.ids[at])

    def around(self, place: int, apart: int) -> slice:
        """Return the positions of the places at most `apart` from a place."""
        first, after = max(place - apart, 0), place + apart + 1
        return slice(first, after) if self.ids is None else slice(*np.searchsorted(self.ids, (first, after)))

    def others(self, place: int, apart: int) -> tuple[np.ndarray, int]:
        """Return the scores of the candidates that are not around a place, float64 (m,), and how many these are.

        A shortlist holds the best alone; there a sample of them are the scores of `usual`.
        """
        usual = self.usual or self
        around = usual.around(place, apart)
        others = np.concatenate([usual.scores[: around.start], usual.scores[around.stop :]]).astype(np.float64)
        others = others[~np.isnan(others)]
        return others, len(others) if self.ids is None else self.places
