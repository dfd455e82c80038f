"""One drive as it goes on: what its frames share, the map that they are compared with, the sums over sequences."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from loopclosure.aggregation.centring import RunningMean, centre_traverse
from loopclosure.config import Config
from loopclosure.matching.index import PlaceIndex
from loopclosure.matching.localisation import Trail
from loopclosure.matching.scored import Scored
from loopclosure.matching.sequences import SequenceScores
from loopclosure.matching.shortlist import SequenceSearch
from loopclosure.methods import Method, PlaceMap, Scores
from loopclosure.store import part
from loopclosure.timing import Stopwatch

Features = np.ndarray | None
"""What a method sees in a frame; None for a frame that could not be read."""


class Traverse:
    """Compare the frames of a drive, one by one, with the drive itself or with a reference.

    Parameters
    ----------
    method : Method
        Fitted before the first `step`.
    config : Config
        All settings.
    clock : Stopwatch
        Takes the time of ``describe`` and ``match``.
    reference : PlaceMap, optional
        The map that alone holds the candidates; without it the drive's own frames are the candidates.
    prior : ndarray of float32, shape (d,), optional
        Mean descriptor to begin with, see `RunningMean`.
    """

    def __init__(
        self,
        method: Method,
        config: Config,
        *,
        clock: Stopwatch,
        reference: PlaceMap | None = None,
        prior: np.ndarray | None = None,
    ) -> None:
        self.one_stream = reference is None
        exclude = config.sequence.exclude_recent if self.one_stream else 0
        self.places = method.new_map(exclude_recent=exclude) if reference is None else reference
        self._method = method
        self._clock = clock
        self._mean = RunningMean(_window(method, config, reference), prior=prior)
        self._recent: deque[np.ndarray] = deque(maxlen=method.window)
        self._sequences: Scores | SequenceSearch = method.new_scores(exclude_recent=exclude)
        if isinstance(self.places, PlaceIndex) and isinstance(self._sequences, SequenceScores):
            self._sequences = SequenceSearch(self.places, self._sequences)
        self._trail: Trail | None = None
        if isinstance(self.places, PlaceIndex):
            both, length = config.sequence.direction == "both", config.sequence.length
            self._trail = Trail(self.places, length=length, exclude_recent=exclude, both_directions=both)

    def step(self, features: Features) -> Scored:
        """Do the method: describe, take out what recent frames share, compare, sum over the sequence, remember."""
        with self._clock("describe"):
            descriptor = describe(self._method, features, self._recent)
            if self._method.centred:
                descriptor = self._method.reduce(self._mean.centre(descriptor))
        with self._clock("match"):
            if isinstance(self._sequences, SequenceSearch):
                scored = self._sequences.push(descriptor)
            else:
                scored = Scored(self._sequences.push(self.places.similarities(descriptor)))
            if self.one_stream:
                self.places.add(descriptor)
            if self._trail is not None:
                self._trail.push(descriptor)
        return scored

    def nearest(self, match: int, frames: int) -> int:
        """Return the place around a candidate that the last `frames` fit best, if a sequence is shorter than that."""
        return match if self._trail is None else self._trail.nearest(match, frames)

    @property
    def mean(self) -> np.ndarray | None:
        """What recent frames share, shape (d,)."""
        return self._mean.current

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        parts = {
            "map": self.places.to_arrays(),
            "mean": self._mean.to_arrays(),
            "sequences": self._sequences.to_arrays(),
            "trail": {} if self._trail is None else self._trail.to_arrays(),
            "recent": {f"{i:06}": features for i, features in enumerate(self._recent)},
        }
        return {f"{name}.{key}": array for name, arrays in parts.items() for key, array in arrays.items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Traverse:
        """Take over the state that `to_arrays` gave, into a traverse with an empty map."""
        self.places.restore(part(arrays, "map"))
        self._mean = RunningMean.from_arrays(part(arrays, "mean"))
        self._sequences.restore(part(arrays, "sequences"))
        if self._trail is not None:
            self._trail.restore(part(arrays, "trail"))
        self._recent.extend(features for _, features in sorted(part(arrays, "recent").items()))
        return self


def describe(method: Method, features: Features, recent: deque[np.ndarray]) -> Any:
    """Describe a frame from its features and from those of the frames before it, which `recent` holds."""
    if features is None:
        return method.blank()
    recent.append(features)
    return method.describe(list(recent))


def describe_traverse(method: Method, config: Config, frames: Sequence[Any]) -> tuple[Any, np.ndarray | None]:
    """Take the mean out of the descriptors of a whole traverse; return what the map keeps of them, and the mean."""
    if not method.centred:
        return frames, None
    centred, mean = centre_traverse(np.stack(frames), window=config.aggregation.centre_window)
    return [method.reduce(descriptor) for descriptor in centred], mean


def _window(method: Method, config: Config, reference: PlaceMap | None) -> int:
    """Frames over which the mean runs; against a reference as many as its own mean was taken over."""
    window = config.aggregation.centre_window if method.centred else 0
    return max(window, len(reference)) if window and reference is not None else window
