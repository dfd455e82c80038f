"""A vocabulary that starts empty: words appear as the drive goes on, and rare ones go."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from loopclosure.aggregation.kmeans import as_vectors, lloyd, nearest
from loopclosure.errors import ConfigError, ModelError

UNKNOWN = -1
"""Stands for the word of a descriptor that no word is near to."""
_RADIUS, _RADIUS_BITS = 0.45, 40.0


class IncrementalWords:
    """Words that are made from what is seen.

    A descriptor belongs to the nearest word within `radius`; one without such a word founds a new word of its own. A
    word that fewer than `min_frames` frames showed within its first `trial` frames is removed, and its number may be
    given to a later word.

    The search is approximate: words lie in cells of at most `cell_size`, and only the `probes` nearest cells are
    searched. A cell that grows beyond splits in two, so that the cost of a frame grows with the number of cells alone.

    Deviations from the sources: one vocabulary of one kind of feature; a word stays the descriptor that founded it,
    neither averaged (Li et al.) nor intersected (iBoW-LCD); no ratio test, because neighbouring words of a repeated
    texture would then found ever new ones; cells with 2-means splits instead of trees.

    Parameters
    ----------
    radius : float, optional
        Largest distance of a descriptor from its word: Euclidean for floats (default 0.45, of RootSIFT), bits for
        packed bits (default 40, of ORB).
    trial : int
        Frames that a new word has to show itself in.
    min_frames : int
        Frames that must have shown it by then.
    cell_size, probes : int
        Of the search.

    References
    ----------
    Angeli et al., "Fast and incremental method for loop-closure detection using bags of visual words", IEEE Trans.
    Robotics 24(5), 2008; Garcia-Fidalgo & Ortiz, "iBoW-LCD", IEEE Robotics and Automation Letters 3(4), 2018.

    Examples
    --------
    >>> words = IncrementalWords()
    >>> features = np.eye(128, dtype=np.float32)[:3]
    >>> words.learn(features, words.find(features))
    (array([0, 1, 2]), array([], dtype=int64))
    >>> words.find(features[::-1])
    array([2, 1, 0])
    """

    def __init__(
        self,
        *,
        radius: float | None = None,
        trial: int = 10,
        min_frames: int = 2,
        cell_size: int = 256,
        probes: int = 8,
    ) -> None:
        if (radius is not None and radius <= 0) or min(trial, min_frames, probes) < 1 or cell_size < 2:
            raise ConfigError(
                f"radius = {radius}, trial = {trial}, min_frames = {min_frames}, cell_size = {cell_size}, "
                f"probes = {probes}: wanted positive numbers and cells of at least 2"
            )
        self.radius, self.trial, self.min_frames = radius, trial, min_frames
        self.cell_size, self.probes = cell_size, probes
        self._clock = 0  # frames learned
        self._vectors = np.zeros((0, 0), np.float32)  # (capacity, d), row = word
        self._cell = np.zeros(0, np.int64)  # of each row, UNKNOWN where no word lives
        self._frames = np.zeros(0, np.int64)  # frames that showed each word
        self._born = np.zeros(0, np.int64)  # clock at its birth
        self._centres = np.zeros((0, 0), np.float32)
        self._members: list[np.ndarray] = []  # words of each cell, ascending

    def __len__(self) -> int:
        """Return the number of words that live now."""
        return int(np.count_nonzero(self._cell >= 0))

    @property
    def nbytes(self) -> int:
        """Bytes that the words take."""
        return self._vectors.nbytes

    @property
    def frames(self) -> np.ndarray:
        """Number of frames that showed each word, shape (largest word + 1,)."""
        return self._frames

    def find(self, descriptors: np.ndarray) -> np.ndarray:
        """Return the word of each descriptor, `UNKNOWN` where none is near enough.

        Parameters
        ----------
        descriptors : ndarray (n, d) float or uint8

        Returns
        -------
        ndarray of int64, shape (n,)
        """
        found = np.full(len(descriptors), UNKNOWN, np.int64)
        if not len(descriptors) or not self._members:
            return found
        vectors = as_vectors(descriptors)
        within = np.full(len(descriptors), self._squared_radius(descriptors))
        for cell, rows in self._visits(vectors):
            words = self._members[cell]
            distance, nth = _nearest_squared(vectors[rows], self._vectors[words])
            closer = distance < within[rows]
            found[rows[closer]] = words[nth[closer]]
            within[rows[closer]] = distance[closer]
        return found

    def learn(self, descriptors: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Count one frame in: words it shows, words that fail their trial, words that are new.

        Parameters
        ----------
        descriptors : ndarray (n, d) float or uint8
        found : ndarray of int64, shape (n,)
            What `find` gave for them.

        Returns
        -------
        words : ndarray of int64, shape (n,)
            The word of each descriptor, new ones included.
        removed : ndarray of int64, shape (k,)
            Words that are no more; their numbers may already be among `words` again.
        """
        words = found.copy()
        self._frames[np.unique(found[found >= 0])] += 1
        self._clock += 1
        removed = np.flatnonzero((self._cell >= 0) & (self._born == self._clock - 1 - self.trial))
        removed = removed[self._frames[removed] < self.min_frames]
        for cell in np.unique(self._cell[removed]).tolist():
            self._members[cell] = np.setdiff1d(self._members[cell], removed, assume_unique=True)
        self._cell[removed] = UNKNOWN
        words[found < 0] = self._found_words(as_vectors(descriptors[found < 0]))
        return words, removed

    def _found_words(self, vectors: np.ndarray) -> np.ndarray:
        """Make a word of each vector."""
        if not len(vectors):
            return np.zeros(0, np.int64)
        free = np.flatnonzero(self._cell < 0)
        if len(free) < len(vectors):
            self._reserve(len(self._cell) + max(len(vectors), len(self._cell) // 4), vectors.shape[1])
            free = np.flatnonzero(self._cell < 0)
        words = free[: len(vectors)]
        self._vectors[words], self._frames[words], self._born[words] = vectors, 1, self._clock - 1
        if not self._members:
            self._centres, self._members = vectors[:1].copy(), [words[:0]]
        self._cell[words] = cells = nearest(vectors, self._centres)
        for cell in np.unique(cells).tolist():
            self._members[cell] = np.union1d(self._members[cell], words[cells == cell])
            self._split(cell)
        return words

    def _reserve(self, rows: int, width: int) -> None:
        more = rows - len(self._cell)
        self._vectors = np.concatenate([self._vectors.reshape(-1, width), np.zeros((more, width), np.float32)])
        self._cell = np.append(self._cell, np.full(more, UNKNOWN))
        self._frames = np.append(self._frames, np.zeros(more, np.int64))
        self._born = np.append(self._born, np.zeros(more, np.int64))

    def _split(self, cell: int) -> None:
        """Split a cell by 2-means, started from two members far apart, until it is small enough."""
        words = self._members[cell]
        if len(words) <= self.cell_size:
            return
        vectors = self._vectors[words]
        first = vectors[np.square(vectors - vectors.mean(0)).sum(1).argmax()]
        second = vectors[np.square(vectors - first).sum(1).argmax()]
        centres = lloyd(vectors, np.stack([first, second]), iterations=5)
        side = nearest(vectors, centres)
        if side.all() or not side.any():
            return  # all of them are equal
        other = len(self._members)
        self._members[cell] = words[side == 0]
        self._members.append(words[side == 1])
        self._cell[words[side == 1]] = other
        self._centres = np.concatenate([self._centres, centres[1:]])
        self._centres[cell] = centres[0]
        self._split(cell)
        self._split(other)

    def _visits(self, vectors: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """Yield each cell to be searched with the rows of `vectors` that look there."""
        distance = np.square(self._centres).sum(1) / 2 - vectors @ self._centres.T
        probes = min(self.probes, len(self._members))
        cells = np.argpartition(distance, probes - 1, axis=1)[:, :probes].ravel()
        order = np.argsort(cells, kind="stable")
        bounds = np.searchsorted(cells[order], np.arange(len(self._members) + 1))
        for cell, (start, end) in enumerate(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)):
            if start < end and len(self._members[cell]):
                yield cell, order[start:end] // probes

    def _squared_radius(self, descriptors: np.ndarray) -> float:
        """Return the radius as a squared distance of the vectors; of bits it is four times their number."""
        if descriptors.dtype == np.uint8:
            return 4.0 * (_RADIUS_BITS if self.radius is None else self.radius)
        return (_RADIUS if self.radius is None else self.radius) ** 2

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return words and cells, for `loopclosure.store`."""
        return {
            "vectors": self._vectors,
            "cell": self._cell,
            "frames": self._frames,
            "born": self._born,
            "centres": self._centres,
            "clock": np.array([self._clock], np.int64),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> IncrementalWords:
        """Take over what `to_arrays` gave; returns the words.

        Raises
        ------
        ModelError
            If the arrays disagree with each other.
        """
        self._vectors, self._cell, self._frames, self._born, self._centres = (
            np.array(arrays[name]) for name in ("vectors", "cell", "frames", "born", "centres")
        )
        self._clock = int(arrays["clock"][0])
        rows, cells = len(self._vectors), len(self._centres)
        if not len(self._cell) == len(self._frames) == len(self._born) == rows or (self._cell >= cells).any():
            raise ModelError("the saved words disagree with their cells: the saved map is damaged")
        self._members = [np.flatnonzero(self._cell == cell) for cell in range(cells)]
        return self


def _nearest_squared(vectors: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return for each vector the squared distance to the nearest of `others` and the row of that one."""
    half = np.square(others).sum(1) / 2 - vectors @ others.T
    nth = half.argmin(1)
    return 2 * half[np.arange(len(vectors)), nth] + np.square(vectors).sum(1), nth
