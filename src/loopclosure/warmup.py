"""Learning from the drive itself: which features are kept, and when the method is fitted on them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopclosure.config import Config

_FEWEST = 10  # frames of a first fit, however small the exclusion band is


class WarmUp:
    """Features of the first frames of a drive, kept until the last fit on them.

    The first fit comes after ``learning.warm_up`` readable frames (``sequence.exclude_recent`` if that is less, but
    never fewer than ten), the others at ``learning.refit_at``. A later fit whose features would take more than
    ``learning.max_kept_mb`` is left out.

    Parameters
    ----------
    config : Config
        Its sections `learning` and `sequence` are used.
    """

    def __init__(self, config: Config) -> None:
        first = max(_FEWEST, min(config.learning.warm_up, config.sequence.exclude_recent))
        self._milestones = [first, *sorted({count for count in config.learning.refit_at if count > first})]
        self._fits = len(self._milestones)
        self._max_bytes = config.learning.max_kept_mb * 1e6
        self.kept: list[np.ndarray | None] = []

    def push(self, features: np.ndarray | None) -> bool:
        """Keep the features of a new frame (None if it was unreadable); return whether to fit now."""
        self.kept.append(features)
        return features is not None and len(self.readable) >= self._milestones[0]

    def fit_done(self) -> None:
        """Go on to the next milestone."""
        self._milestones = self._milestones[1:]

    def take_back(self) -> None:
        """Forget the last frame."""
        self.kept.pop()

    @property
    def readable(self) -> list[np.ndarray]:
        """The features that there are."""
        return [features for features in self.kept if features is not None]

    @property
    def finished(self) -> bool:
        """Whether no fit comes any more, so that the features can go."""
        if len(self._milestones) == self._fits or not self.readable:
            return False
        return not self._milestones or self.readable[0].nbytes * self._milestones[0] > self._max_bytes

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        arrays = {f"kept{i}": features for i, features in enumerate(self.kept) if features is not None}
        return {"count": np.array(len(self.kept)), "milestones": np.array(self._milestones, np.int64), **arrays}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> WarmUp:
        """Take over the state that `to_arrays` gave."""
        self.kept = [arrays.get(f"kept{i}") for i in range(int(arrays["count"]))]
        self._milestones = [int(count) for count in arrays["milestones"]]
        return self
