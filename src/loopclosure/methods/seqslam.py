"""SeqSLAM online: thumbnails compared pixel by pixel, and straight trajectories through the differences.

Milford and Wyeth, ICRA 2012; OpenSeqSLAM (2013). Deviations from it, beside those of `TrajectorySearch`:

- Patches have 4 x 4 pixels and are not quantised, images are compared after sideways shifts of up to 8 pixels, and
  differences are divided by their mean over the references instead of by local contrast. ``seqslam.faithful``
  brings back 8 x 8 quantised patches, no shifts, and local contrast.
- A trajectory has ``sequence.length`` frames: OpenSeqSLAM's ``ds = 10`` is a length of 11.
- In one stream, frames nearer than ``sequence.exclude_recent`` are left out of the search and of the mean.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.features.thumbnails import thumbnails
from loopclosure.matching.differences import difference_row, enhance_row, relative_differences
from loopclosure.matching.similarity import VectorMap
from loopclosure.matching.velocities import TrajectorySearch
from loopclosure.methods.base import Method

_SHIFTS = range(-8, 9, 2)


class SeqSLAM(Method):
    """Describe frames by patch-normalised thumbnails and match trajectories of several speeds.

    A score is 1 less the mean difference along the best trajectory that ends at the candidate: 1 for equal frames,
    0 (0.5 with local contrast) for frames as unlike as all references are on average.

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
        self.threshold = 0.84 if self._faithful else 0.25
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

    def new_map(self, *, exclude_recent: int) -> ThumbnailMap:
        """Return an empty map for thumbnails."""
        return ThumbnailMap(exclude_recent=exclude_recent, local_contrast=self._faithful)

    def new_scores(self, *, exclude_recent: int) -> TrajectoryScores:  # noqa: ARG002  (the map leaves those frames out)
        """Return the search for trajectories of `sequence.length` frames, at least two."""
        return TrajectoryScores(ds=max(self.config.sequence.length - 1, 1))


class ThumbnailMap(VectorMap):
    """Thumbnails of all frames so far, compared by relative differences or by their local contrast.

    Parameters
    ----------
    exclude_recent : int
        In one stream, frames nearer than this are no candidates; 0 for another traverse.
    local_contrast : bool
        Whether to compare as OpenSeqSLAM does, without shifts.
    """

    def __init__(self, *, exclude_recent: int = 0, local_contrast: bool = False) -> None:
        super().__init__()
        self._excluded = max(exclude_recent - 1, 0)  # the new frame itself is not in the map yet
        self._local_contrast = local_contrast

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
        row[:candidates] = 1 - self._differences(descriptor, candidates)
        return row

    def _differences(self, thumbnail: np.ndarray, candidates: int) -> np.ndarray:
        shifts = (0,) if self._local_contrast else _SHIFTS
        row, blank = np.zeros(candidates, np.float32), np.zeros(candidates, bool)
        start = 0
        for block in self._filled():
            block, end = block[: max(candidates - start, 0)], start + len(block)
            # difference_row divides by the length of the block, which must not tell on the result
            row[start:end] = difference_row(thumbnail, block, shifts=shifts) * len(block)
            blank[start:end] = ~block.any(axis=(1, 2))
            start = end
        if self._local_contrast:
            return enhance_row(row)
        return relative_differences(row, blank) if thumbnail.any() else np.ones_like(row)


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
            At most 1; minus infinity where there is no candidate.

        Returns
        -------
        ndarray of float32, shape (n,)
            Mean similarity along the best trajectory; NaN where none is complete.
        """
        return 1 + self._search.push(1 - similarities)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the state, for `loopclosure.store`."""
        return self._search.to_arrays()

    def restore(self, arrays: Mapping[str, np.ndarray]) -> TrajectoryScores:
        """Take over the state that `to_arrays` gave."""
        self._search.restore(arrays)
        return self
