"""What is kept of a drive for verification: pictures of every few frames, features of those that are asked for."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopclosure.errors import ModelError
from loopclosure.verification.local_features import LocalFeatures
from loopclosure.verification.pictures import pack_picture, unpack_picture
from loopclosure.verification.verifier import Verifier

_BACK = 2  # views between which the robot has moved on far enough that what stays still is no part of the place
_REMEMBERED = 400  # sets of features, two of a view, that are not computed again; 70 kB each


class Views:
    """Pictures of frames ``0, every, 2 * every ...`` of one drive, and their local features.

    Most places never become candidates, so that features are computed when they are first asked for. What stays where
    it is in the view while the robot moves, such as the bonnet, the rim of a lens, or a lorry that drives ahead, is
    left out: it says nothing about the place.

    Parameters
    ----------
    verifier : Verifier
        Finds the features, and matches a view with the one before last.
    every : int
        Frames from one view to the next.
    """

    def __init__(self, verifier: Verifier, *, every: int) -> None:
        self.every = every
        self.verifier = verifier
        self._pictures: list[bytes] = []  # empty for a frame that could not be read
        self._found: dict[tuple[int, bool], LocalFeatures | None] = {}

    def __len__(self) -> int:
        return len(self._pictures)

    @property
    def nbytes(self) -> int:
        """Bytes that the pictures take."""
        return sum(map(len, self._pictures))

    def wanted(self, frame: int) -> bool:
        """Whether a picture of this frame is kept."""
        return frame % self.every == 0

    def pack(self, image: np.ndarray) -> bytes:
        """Return what `add` takes of an image, ndarray of uint8 (h, w, 3), RGB."""
        return pack_picture(image, self.verifier.side)

    def add(self, picture: bytes | None) -> None:
        """Keep the next view; None for a frame that could not be read."""
        self._pictures.append(picture or b"")

    def nearest(self, frame: int) -> tuple[int, LocalFeatures | None]:
        """Return the frame nearest to `frame` that has a view, and its features; None where it could not be read."""
        view = min(round(frame / self.every), len(self) - 1)
        return view * self.every, self._features(view, moving=True)

    def _features(self, view: int, *, moving: bool) -> LocalFeatures | None:
        key = view, moving
        if key not in self._found:
            self._found[key] = self._moving(view) if moving else self._all(view)
            if len(self._found) > _REMEMBERED:
                del self._found[next(iter(self._found))]
        return self._found[key]

    def _all(self, view: int) -> LocalFeatures | None:
        if view < 0 or not self._pictures[view]:
            return None
        return self.verifier.features(unpack_picture(self._pictures[view], self.verifier.side))

    def _moving(self, view: int) -> LocalFeatures | None:
        features, earlier = self._features(view, moving=False), self._features(view - _BACK, moving=False)
        if features is None or earlier is None:
            return features
        return self.verifier.without_still(features, earlier)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        return {
            "every": np.array(self.every),
            "lengths": np.array([len(picture) for picture in self._pictures], np.int64),
            "pictures": np.frombuffer(b"".join(self._pictures), np.uint8),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Views:
        """Take over the state that `to_arrays` gave."""
        self.every, lengths = int(arrays["every"]), arrays["lengths"]
        packed = arrays["pictures"].tobytes()
        if self.every < 1 or (lengths < 0).any() or lengths.sum() != len(packed):
            raise ModelError(f"{len(packed)} bytes of views, wanted {lengths.sum()}: is the file damaged?")
        ends = np.cumsum(lengths).tolist()
        self._pictures = [packed[start:end] for start, end in zip([0, *ends], ends, strict=False)]
        return self
