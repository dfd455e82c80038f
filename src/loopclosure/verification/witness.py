"""Verification along the way: nearly all pairs of frames must agree, not one or two of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from loopclosure.verification.views import Views

_REMEMBERED = 20  # frames: a zebra crossing, or the like of a lorry, is sooner out of sight
_AGREE = 0.85  # share of the looks in this time that are asked to agree
_SLACK, _SLACK_A_FRAME, _MOST_SLACK = 2.0, 0.5, 7.0  # frames by which two drives on one track may differ in pace


class Heard(NamedTuple):
    """What the frames of a sequence say of a candidate.

    Attributes
    ----------
    support : float
        Mean support (`Verification.support`) of the frames that were looked at on the way to the candidate, the worst
        ones left out; a look that was not taken counts as 0.
    inliers : int or None
        Of the best one; None where no pair was looked at.
    """

    support: float
    inliers: int | None


class Witness:
    """Verify the candidates of those frames that have a view, and remember for the others.

    Parameters
    ----------
    drive, places : Views
        Of the frames that come in, and of the map; the same object in one stream.
    both_directions : bool
        Whether a place may also be driven through the other way.
    """

    def __init__(self, drive: Views, places: Views, *, both_directions: bool = False) -> None:
        self._drive, self._places, self._both = drive, places, both_directions
        self._asked = max(round(_AGREE * _REMEMBERED / drive.every), 1)
        self._seen = np.zeros((0, 4))  # query, match, support, inliers

    def hear(self, query: int, matches: Sequence[int], *, look_at: Sequence[int]) -> list[Heard]:
        """Return what is known of each candidate of a frame, after a look at some of them if the frame has a view."""
        self._seen = self._seen[self._seen[:, 0] > query - _REMEMBERED]
        if self._drive.wanted(query) and len(self._places) and look_at:
            self._look(query, look_at)
        age = query - self._seen[:, 0]
        return [self._on_the_way(match - self._seen[:, 1], age) for match in matches]

    def _look(self, query: int, matches: Sequence[int]) -> None:
        seen = self._drive.nearest(query)[1]
        for frame, place in dict(map(self._places.nearest, matches)).items():
            if seen is not None and place is not None:
                found = self._drive.verifier.verify(seen, place)
                self._seen = np.vstack([self._seen, (query, frame, found.support, found.inliers)])

    def _on_the_way(self, moved: np.ndarray, age: np.ndarray) -> Heard:
        off = np.abs(np.abs(moved) - age if self._both else moved - age)
        near = self._seen[off <= np.minimum(_SLACK + _SLACK_A_FRAME * age, _MOST_SLACK)]
        if not len(near):
            return Heard(0.0, None)
        near = near[np.argsort(-near[:, 2], kind="stable")]
        best = near[np.sort(np.unique(near[:, 0], return_index=True)[1])][: self._asked]  # one look a frame
        return Heard(float(best[:, 2].sum()) / self._asked, int(best[0, 3]))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        return {"seen": self._seen}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Witness:
        """Take over the state that `to_arrays` gave."""
        self._seen = arrays["seen"]
        return self
