"""SeqSLAM online: thumbnails compared patch by patch, and straight trajectories through the similarities.

Milford and Wyeth, ICRA 2012; OpenSeqSLAM (2013). Deviations from it, beside those of `TrajectorySearch`:

- Patches have 4 x 4 pixels and are not quantised; images are compared by correlation after sideways shifts of up to 8
  pixels instead of by absolute differences, and in standard deviations over all references instead of by local
  contrast, see `CorrelationMap`. ``seqslam.faithful`` brings back 8 x 8 quantised patches, absolute differences
  without shifts, and local contrast.
- A trajectory has ``sequence.length`` frames: OpenSeqSLAM's ``ds = 10`` is a length of 11.
- In one stream, frames nearer than ``sequence.exclude_recent`` are left out of the search and of the statistics.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.features.thumbnails import thumbnails
from loopclosure.matching.correlation import CorrelationMap
from loopclosure.matching.differences import difference_row, enhance_row
from loopclosure.matching.similarity import VectorMap
from loopclosure.matching.velocities import TrajectorySearch
from loopclosure.methods.base import Method

_SHIFTS = range(-8, 9, 2)


class SeqSLAM(Method):
    """Describe frames by patch-normalised thumbnails and match trajectories of several speeds.

    A score is the mean along the best trajectory that ends at the candidate: of standard deviations by which the
    correlation exceeds that of all candidates, 0 for frames that are as all of them are on average; with local
    contrast of 1 less the difference, 1 for frames that stand out as far as can be, 0.5 for all others on average.

    Parameters
    ----------
    config : Config
        Its sections `seqslam` and `sequence` are used.

    Raises
    ------
    ConfigError
        If the thumbnail cannot be cut into patches, or a reversed drive is asked for.
    """

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        if config.sequence.direction != "forward":
            raise ConfigError("sequence.direction = 'both': seqslam finds streets that are driven forward alone")
        self._faithful = config.seqslam.faithful
        self.threshold = 0.84 if self._faithful else 2.45
        self.features([])  # refuses sizes that cannot be cut into patches

    def features(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the thumbnail of each image, float32 (height, width), or uint8 where it is quantised."""
        size = self.config.seqslam
        patch = 8 if self._faithful else 4
        return list(thumbnails(images, width=size.width, height=size.height, patch=patch, quantise=self._faithful))

    def describe(self, features: Sequence[np.ndarray]) -> np.ndarray:
        """Return the thumbnail of the newest frame, float32 (height, width)."""
        return np.asarray(features[-1], np.float32)

    def blank(self) -> np.ndarray:
        """Return the thumbnail of an image without structure."""
        return np.zeros((self.config.seqslam.height, self.config.seqslam.width), np.float32)

    def new_map(self, *, exclude_recent: int) -> ContrastMap | CorrelationMap:
        """Return an empty map for thumbnails."""
        if self._faithful:
            return ContrastMap(exclude_recent=exclude_recent)
        return CorrelationMap(shifts=_SHIFTS, exclude_recent=exclude_recent)

    def new_scores(self, *, exclude_recent: int) -> TrajectoryScores:  # noqa: ARG002  (the map leaves those frames out)
        """Return the search for trajectories of `sequence.length` frames, at least two."""
        return TrajectoryScores(ds=max(self.config.sequence.length - 1, 1))


class ContrastMap(VectorMap):
    """Thumbnails of all frames so far, compared by local contrast as OpenSeqSLAM does.

    Parameters
    ----------
    exclude_recent : int
        In one stream, frames nearer than this are no candidates; 0 for another traverse.
    """

    def __init__(self, *, exclude_recent: int = 0) -> None:
        super().__init__()
        self._excluded = max(exclude_recent - 1, 0)  # the new frame itself is not in the map yet

    def similarities(self, descriptor: np.ndarray) -> np.ndarray:
        """Compare one thumbnail with all stored ones.

        Parameters
        ----------
        descriptor : ndarray of float32, shape (height, width)

        Returns
        -------
        ndarray of float32, shape (n,)
            1 less the difference, at most 1; minus infinity for frames that are no candidates.
        """
        row = np.full(len(self), -np.inf, np.float32)
        candidates = max(len(self) - self._excluded, 0)
        if candidates:
            # difference_row divides by the length of the block, which must not tell on the result
            sums = [difference_row(descriptor, block) * len(block) for block in self._filled()]
            row[:candidates] = 1 - enhance_row(np.concatenate(sums)[:candidates])
        return row


class TrajectoryScores:
    """`TrajectorySearch` as the detector wants it: similarities in, scores out.

    Parameters
    ----------
    ds : int
        Steps of a trajectory, frames.
    """

    def __init__(self, *, ds: int) -> None:
        self._search = TrajectorySearch(ds=ds)

    def push(self, similarities: np.ndarray) -> np.ndarray:
        """Take the row of a new frame and score every trajectory that ends at it.

        Parameters
        ----------
        similarities : ndarray of float32, shape (n,)
            Larger = more alike; minus infinity where there is no candidate.

        Returns
        -------
        ndarray of float32, shape (n,)
            Mean similarity along the best trajectory; NaN where none is complete.
        """
        return self._search.push(-similarities)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        return self._search.to_arrays()

    def restore(self, arrays: Mapping[str, np.ndarray]) -> TrajectoryScores:
        """Take over the state that `to_arrays` gave."""
        self._search.restore(arrays)
        return self
