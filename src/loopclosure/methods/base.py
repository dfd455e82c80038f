"""What `detect.LoopDetector` asks of a method; warm-up, references, decisions and saving are the detector's."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from loopclosure.config import Config
from loopclosure.matching.sequences import SequenceScores


class PlaceMap(Protocol):
    """Descriptors of all frames seen so far."""

    def __len__(self) -> int: ...
    @property
    def nbytes(self) -> int:
        """Bytes that the stored descriptors take."""

    def add(self, descriptor: Any) -> None:
        """Store one frame."""

    def similarities(self, descriptor: Any) -> np.ndarray:
        """Compare one frame with all stored ones: float32 (n,), larger = more alike."""

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what is stored, for `loopclosure.store`."""

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """Take over what `to_arrays` gave; returns the map."""


class Scores(Protocol):
    """Similarities of frames to scores of candidates, one row a frame."""

    def push(self, similarities: np.ndarray) -> np.ndarray:
        """Take the row of a new frame, float32 (n,), and return its scores, NaN where there is no candidate."""

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""

    def restore(self, arrays: Mapping[str, np.ndarray]) -> Any:
        """Take over the state that `to_arrays` gave; returns the object."""


class Method(ABC):
    """One way to tell whether two frames show the same place.

    Parameters
    ----------
    config : Config
        All settings; a method reads the sections that concern it.

    Attributes
    ----------
    fitted : bool
        Whether `describe` can be called.
    centred : bool
        Whether descriptors are vectors from which the running mean of the traverse is taken out.
    window : int
        Frames whose features `describe` is given: it describes the newest and sees by the others what has changed.
    whole_sequences : bool
        Whether one descriptor stands for all frames of a sequence.
    threshold : float
        Least score of a loop where the configuration sets none.
    calibrated : bool
        Whether similarities mean the same on every drive, so that `loopclosure.decision` knows the odds of a loop. A
        score is then a probability, and no threshold of the method is needed.
    sums : type
        Of `SequenceScores`, the one that sums similarities over sequences.
    input_size : tuple of 2 int, or None
        Height and width, pixels, to which `features` shrinks every image first; None where it needs all pixels.
    """

    fitted = True
    centred = False
    window = 1
    whole_sequences = False
    threshold = 0.5
    calibrated = False
    sums: type[SequenceScores] = SequenceScores
    input_size: tuple[int, int] | None = None

    def __init__(self, config: Config) -> None:
        self.config = config

    @property
    def provenance(self) -> dict[str, Any]:
        """Where the weights came from, if there are any; a saved model must find the same."""
        return {}

    @abstractmethod
    def features(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Turn uint8 RGB images (h, w, 3) into one array of features each: the costly part."""

    @abstractmethod
    def describe(self, features: Sequence[np.ndarray]) -> Any:
        """Describe the newest of the last `window` frames from their features, oldest first."""

    def reduce(self, centred: Any) -> Any:
        """Return what the map keeps of a descriptor from which the mean was taken out."""
        return centred

    @abstractmethod
    def blank(self) -> Any:
        """Return the descriptor of a frame that says nothing."""

    @abstractmethod
    def new_map(self, *, exclude_recent: int) -> PlaceMap:
        """Return an empty map; in one stream, frames nearer than `exclude_recent` (0 = all) are no candidates."""

    def new_scores(self, *, exclude_recent: int) -> Scores:
        """Return what sums similarities over sequences: Eq. 20 unless the method brings its own."""
        sequence = self.config.sequence
        return self.sums(
            1 if self.whole_sequences else sequence.length,
            exclude_recent=exclude_recent,
            both_directions=sequence.direction == "both",
            history=sequence.length,
        )

    def fit(self, features: Sequence[np.ndarray]) -> None:  # noqa: B027
        """Learn from the features of consecutive frames; nothing to do where nothing is learned."""

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned."""
        return {}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:  # noqa: B027
        """Take over what `to_arrays` gave."""
