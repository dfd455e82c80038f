"""Images to what a drive keeps of them: features of the method, and, of some frames, a picture to verify loops by."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Any, NamedTuple, Protocol

import numpy as np

from loopclosure.images.ahead import in_batches, read_ahead
from loopclosure.images.decode import check_image
from loopclosure.images.sequence import ImageSequence
from loopclosure.methods import Method
from loopclosure.timing import Stopwatch
from loopclosure.verification import Verifier, Views

_BATCH = 8  # frames whose features are computed together where frames are not live


class Frames(Protocol):
    """A traverse: uint8 RGB images (h, w, 3), None for an unreadable one. A list will do; so does `ImageSequence`."""

    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[np.ndarray | None]: ...
    def __getitem__(self, index: int, /) -> np.ndarray | None: ...


class Seen(NamedTuple):
    """What is seen in a frame: features of the method, and, of some frames, a picture; None where it is unreadable."""

    features: np.ndarray | None
    picture: bytes | None


class Perception:
    """Look at images.

    Parameters
    ----------
    method : Method
        Whose features are computed.
    views : Views or None
        Say of which frames a picture is kept; None where nothing is verified.
    clock : Stopwatch
        Takes the time of ``features`` and ``picture``.
    """

    def __init__(self, method: Method, views: Views | None, clock: Stopwatch) -> None:
        self._method, self._views, self._clock = method, views, clock

    def look(self, index: int, image: np.ndarray | None) -> Seen:
        """Look at one frame, which comes with its position in the drive."""
        return self._look_at([(index, None if image is None else check_image(image))])[0][1]

    def look_ahead(self, frames: Iterable[tuple[int, np.ndarray | None]]) -> Iterator[tuple[int, Seen]]:
        """Yield what is seen in each frame: one thread decodes, one computes in batches, both ahead of the caller."""
        checked = ((index, None if image is None else check_image(image)) for index, image in frames)
        batches = in_batches(read_ahead(checked), _BATCH)
        return chain.from_iterable(read_ahead(map(self._look_at, batches), depth=1))

    def look_at_some(self, images: Frames, chosen: list[int]) -> Iterator[tuple[int, Seen]]:
        """Look at the chosen frames; a video is read through once, because a jump in it costs a decoder of its own."""
        if getattr(images, "is_video", False):
            wanted = set(chosen)
            return self.look_ahead((index, image) for index, image in enumerate(images) if index in wanted)
        return self.look_ahead((index, images[index]) for index in chosen)

    def as_needed(self, images: Any) -> Any:
        """Spare an image sequence the pixels that would be thrown away."""
        if self._method.input_size is None or not isinstance(images, ImageSequence):
            return images
        least = 0 if self._views is None else Verifier.side
        return images.reduced(*(max(size, least) for size in self._method.input_size))

    def _look_at(self, frames: list[tuple[int, np.ndarray | None]]) -> list[tuple[int, Seen]]:
        readable = [image for _, image in frames if image is not None]
        with self._clock("features"):
            found = iter(self._method.features(readable) if readable else ())
        return [
            (index, Seen(None, None) if image is None else Seen(next(found), self._picture(index, image)))
            for index, image in frames
        ]

    def _picture(self, index: int, image: np.ndarray) -> bytes | None:
        if self._views is None or not self._views.wanted(index):
            return None
        with self._clock("picture"):
            return self._views.pack(image)
