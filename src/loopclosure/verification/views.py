"""What is kept of a drive for verification: the local features of every few frames."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopclosure.store import part
from loopclosure.verification.local_features import LocalFeatures
from loopclosure.verification.verifier import Verifier

_BACK = 2  # views between which the robot has moved on far enough that what stays still is no part of the place


class Views:
    """Local features of frames ``0, every, 2 * every ...`` of one drive.

    What stays where it is in the view while the robot moves, such as the bonnet, the rim of a lens, or a lorry that
    drives ahead, is left out: it says nothing about the place.

    Parameters
    ----------
    verifier : Verifier
        Matches a view with the one before last.
    every : int
        Frames from one view to the next.
    """

    def __init__(self, verifier: Verifier, *, every: int) -> None:
        self.every = every
        self.verifier = verifier
        self._recent: list[LocalFeatures | None] = []  # whole, for the next ones to be compared with
        self._kept: list[LocalFeatures | None] = []

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def nbytes(self) -> int:
        """Bytes that the features take."""
        return sum(features.nbytes for features in self._kept if features is not None)

    def wanted(self, frame: int) -> bool:
        """Whether the features of this frame are kept."""
        return frame % self.every == 0

    def add(self, features: LocalFeatures | None) -> None:
        """Keep the next view; None for a frame that could not be read."""
        earlier = self._recent[0] if len(self._recent) == _BACK else None
        moving = features
        if features is not None and earlier is not None:
            moving = self.verifier.without_still(features, earlier)
        self._kept.append(moving)
        self._recent = [*self._recent[1 - _BACK :], features]

    def nearest(self, frame: int) -> tuple[int, LocalFeatures | None]:
        """Return the frame nearest to `frame` that has a view, and its features."""
        view = min(round(frame / self.every), len(self._kept) - 1)
        return view * self.every, self._kept[view]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        arrays = {"count": np.array([len(self._kept), len(self._recent)])}
        for name, group in (("kept", self._kept), ("recent", self._recent)):
            for i, features in enumerate(group):
                if features is not None:
                    arrays |= {f"{name}{i}.{key}": array for key, array in features.to_arrays().items()}
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Views:
        """Take over the state that `to_arrays` gave."""

        def group(name: str, count: int) -> list[LocalFeatures | None]:
            parts = (part(arrays, f"{name}{i}") for i in range(count))
            return [LocalFeatures.from_arrays(found) if found else None for found in parts]

        kept, recent = map(int, arrays["count"])
        self._kept, self._recent = group("kept", kept), group("recent", recent)
        return self
