"""The map beyond some 10,000 places: short codes say which places may be near a frame, their vectors how near."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from loopclosure.errors import ModelError
from loopclosure.matching.similarity import VectorMap
from loopclosure.store import part

_BLOCK = 1 << 22  # numbers; memory grows block by block, and a few large ones are quick to gather rows from
_LEAST_ROWS = 1024  # of a block, however long the vectors
_STEP = 256  # places after which codes are made: rare and bounded, so that no `add` stalls
_CODED = 3 * _STEP  # places that a step makes codes of: the new ones and twice as many of those before
_GROWTH = 4  # a map so many times larger gets a code learned anew
_SAMPLE = 2048  # places that a code is learned from
_ROUNDS = 5  # of k-means; more of them find no more
_SURVIVORS = 1000  # places, near by their codes, that are compared exactly
_AT_ONCE = 1 << 15  # places that are coded in one go where an index is loaded
LONGEST = 256
"""Numbers in a vector; longer ones are always compared with all."""
_BITS, _LEVELS = 4, 16  # of one centre; how many there are
_CODES = ("live", "next")


class PlaceIndex(VectorMap):
    """Unit vectors, of which the most similar ones are found in two looks.

    Up to `flat_up_to` places a search compares with all of them. Beyond that every place also has a code of four bits
    for each two numbers. All codes are compared first, from tables in registers; the 1,000 best, and the places that
    have no code yet, are then compared by their float32 vectors. The code is learned when the map has outgrown
    `flat_up_to`, and anew whenever it is four times as large; places are coded by a bounded step every 256, and until
    all of them are, the code before answers. Whatever was added in the same order gives the same answers.

    Parameters
    ----------
    flat_up_to : int
        Places up to which nothing is approximate.

    Notes
    -----
    An inverted file is worse here (``benchmarks/scale.py --first-looks``): whitening spreads descriptors over all their
    dimensions, the neighbours of a place lie in many lists, and half of these have to be read.

    References
    ----------
    Jegou et al., "Product quantization for nearest neighbor search", PAMI 2011; tables in registers: Andre et al.,
    "Cache locality is not enough", VLDB 2015; both as in faiss (Douze et al., "The Faiss library", 2024).

    Examples
    --------
    >>> places = PlaceIndex().restore({"descriptors": np.eye(3, dtype=np.float32)})
    >>> places.search(np.array([0.6, 0.0, 0.8], np.float32), 2)
    (array([2, 0]), array([0.8, 0.6], dtype=float32))
    """

    def __init__(self, *, flat_up_to: int = 50_000) -> None:
        super().__init__()
        self._flat_up_to = max(flat_up_to, _STEP)
        self._removed = np.zeros(0, np.int64)
        self._codes: list[_Codes] = []  # those that answer where they are complete, and the next ones

    @property
    def exact(self) -> bool:
        """Whether a search compares with all places."""
        return not self._codes or self._codes[0].filled < self._whole

    @property
    def nbytes(self) -> int:
        """Bytes that vectors and codes take."""
        return super().nbytes + sum(codes.nbytes for codes in self._codes)

    def add(self, descriptor: np.ndarray) -> None:
        """Store one place; its id is the number of places before it.

        Parameters
        ----------
        descriptor : ndarray of float32, shape (d,)
            Unit vector; zeros for a blank or unreadable frame.
        """
        self._store(descriptor)
        if self._length % _STEP == 0:
            self._step()

    def remove(self, ids: np.ndarray) -> None:
        """Forget places: no search finds them any more, their vectors become zeros; other ids stay as they are.

        Parameters
        ----------
        ids : ndarray of int, shape (m,)
        """
        ids = np.unique(np.asarray(ids, np.int64))
        if ids.size and not 0 <= ids[0] <= ids[-1] < len(self):
            raise ModelError(f"cannot remove places {ids[0]} to {ids[-1]}: the index holds {len(self)}, from 0")
        for i in ids:
            block, row = divmod(i, len(self._blocks[0]))
            self._blocks[block][row] = 0
        self._removed = np.union1d(self._removed, ids)

    def rows(self, ids: np.ndarray) -> np.ndarray:
        """Return the vectors of places.

        Parameters
        ----------
        ids : ndarray of int, shape (...)

        Returns
        -------
        ndarray of float32, shape (..., d)
        """
        rows = np.empty((*ids.shape, *self._blocks[0].shape[1:]), np.float32)
        block, row = np.divmod(ids, len(self._blocks[0]))
        for number in np.flatnonzero(np.bincount(block.ravel())):
            chosen = block == number
            rows[chosen] = self._blocks[number][row[chosen]]
        return rows

    def search(self, descriptor: np.ndarray, k: int, *, newest: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Find the places most similar to a frame.

        Parameters
        ----------
        descriptor : ndarray of float32, shape (d,)
            Unit vector, or zeros.
        k : int
            Places wanted; fewer are returned where there are not so many.
        newest : int, optional
            Last id that may be returned; none = the last one there is.

        Returns
        -------
        ids : ndarray of int64, shape (<= k,)
            Best first; of equal ones the older first.
        cosines : ndarray of float32, shape (<= k,)
            Exact, larger = more alike.
        """
        stop = len(self) if newest is None else min(newest + 1, len(self))
        if stop <= 0 or k <= 0:
            return np.zeros(0, np.int64), np.zeros(0, np.float32)
        if not self.exact:
            wanted = max(_SURVIVORS, 3 * k)
            near = self._codes[0].search(descriptor, wanted)
            near = near[(near < stop) & ~np.isin(near, self._removed)]
            if near.size > wanted // 2:  # not where most of what is near may not be returned
                ids = np.concatenate([near, self._kept(self._codes[0].filled, stop)])
                return _best(ids, self.rows(ids) @ descriptor, k)
        ids = self._kept(0, stop)
        blocks = self._filled()[: math.ceil(stop / len(self._blocks[0]))]
        return _best(ids, np.concatenate([block @ descriptor for block in blocks])[ids], k)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return vectors, removed ids and how codes are made, for `loopclosure.store`."""
        arrays = super().to_arrays()
        if self._removed.size:
            arrays["removed"] = self._removed
        for name, codes in zip(_CODES, self._codes, strict=False):
            arrays |= {f"{name}.{key}": array for key, array in codes.to_arrays().items()}
        return arrays

    def restore(self, arrays: Mapping[str, np.ndarray]) -> PlaceIndex:
        """Take over what `to_arrays` gave, into an empty index; the codes are made anew."""
        for descriptor in arrays.get("descriptors", ()):
            self._store(descriptor)
        self.remove(arrays.get("removed", self._removed))
        if self._whole > self._flat_up_to:
            self._codes = [self._codes_again(saved) for name in _CODES if (saved := part(arrays, name))]
        if not self._codes:  # saved by a plain map, or small
            self._step()
            while self._codes and self.exact:
                self._step()
        return self

    @property
    def _whole(self) -> int:
        """Places that have a code where all have that can; the few after them wait for the next step."""
        return self._length - self._length % _STEP

    def _store(self, descriptor: np.ndarray) -> None:
        if np.ndim(descriptor) != 1:
            raise ModelError(f"the index takes one vector a place, found shape {np.shape(descriptor)}; a set of them?")
        size = len(self._blocks[0]) if self._blocks else max(_BLOCK // len(descriptor), _LEAST_ROWS)
        block, row = divmod(self._length, size)
        if row == 0:
            self._blocks.append(np.empty((size, len(descriptor)), np.float32))
        if self._blocks[block].shape[1] != len(descriptor):
            raise ModelError(
                f"the index holds vectors of {self._blocks[0].shape[1]} numbers, this frame's has {len(descriptor)}; "
                "were they made by the same method?"
            )
        self._blocks[block][row] = descriptor
        self._length += 1

    def _filled(self) -> list[np.ndarray]:
        return [block[: self._length - i * len(block)] for i, block in enumerate(self._blocks)]

    def _kept(self, start: int, stop: int) -> np.ndarray:
        """Ids from `start` up to `stop` without those that were removed."""
        low, high = np.searchsorted(self._removed, (start, stop))
        return np.delete(np.arange(start, stop), self._removed[low:high] - start)

    def _step(self) -> None:
        """Learn a code where the map has outgrown the last one, and code a bounded number of places."""
        outgrown = _GROWTH * self._codes[-1].born if self._codes else self._flat_up_to
        if self._whole > outgrown and len(self._codes) < len(_CODES) and self._blocks[0].shape[1] <= LONGEST:
            sample = self.rows(np.linspace(0, self._whole - 1, min(_SAMPLE, self._whole)).astype(np.int64))
            self._codes.append(_Codes.learn(sample, born=self._whole))
        for codes in self._codes:
            self._code(codes, min(codes.filled + _CODED, self._whole))
        if len(self._codes) > 1 and self._codes[1].filled == self._whole:
            del self._codes[0]

    def _code(self, codes: _Codes, stop: int) -> None:
        codes.add(self.rows(np.arange(codes.filled, stop)))

    def _codes_again(self, arrays: Mapping[str, np.ndarray]) -> _Codes:
        """Return the codes that ``_Codes.to_arrays`` described, of as many places as there were."""
        born, filled = (int(number) for number in arrays["progress"])
        d = self._blocks[0].shape[1]
        if not (arrays["centres"].shape == (_LEVELS * d,) and 0 < born <= len(self) and 0 <= filled <= self._whole):
            raise ModelError(f"the saved codes do not belong to these {len(self)} places: the file is damaged")
        codes = _Codes(d, born=born, centres=arrays["centres"])
        while codes.filled < filled:
            self._code(codes, min(codes.filled + _AT_ONCE, filled))
        return codes


class _Codes:
    """Codes of places 0, 1, 2 ...: each two numbers (each one, of an odd number of them) by the nearest of 16 centres.

    Parameters
    ----------
    d : int
        Numbers in a vector.
    born : int
        Places there were when the code was learned.
    centres : ndarray of float32, shape (16 * d,)
        What `to_arrays` gave.
    """

    def __init__(self, d: int, *, born: int, centres: np.ndarray | None = None) -> None:
        import faiss  # takes a tenth of a second, and only large maps need it

        self.born = born
        self._faiss = faiss.IndexPQFastScan(d, d if d % 2 else d // 2, _BITS, faiss.METRIC_INNER_PRODUCT)
        if centres is not None:
            faiss.copy_array_to_vector(np.ascontiguousarray(centres, np.float32), self._faiss.pq.centroids)
            self._faiss.is_trained = True

    @classmethod
    def learn(cls, sample: np.ndarray, *, born: int) -> _Codes:
        """Learn the centres from vectors, float32 (m, d), by k-means with a fixed seed."""
        codes = cls(sample.shape[1], born=born)
        codes._faiss.pq.cp.niter = _ROUNDS
        codes._faiss.pq.cp.min_points_per_centroid = 1  # no warning on standard error
        codes._faiss.train(sample)
        return codes

    @property
    def filled(self) -> int:
        """Places that have a code."""
        return self._faiss.ntotal

    @property
    def nbytes(self) -> int:
        """Bytes that the codes take."""
        return self.filled * self._faiss.code_size

    def add(self, rows: np.ndarray) -> None:
        """Code the next places, float32 (m, d)."""
        self._faiss.add(rows)

    def search(self, descriptor: np.ndarray, k: int) -> np.ndarray:
        """Return the ids of up to `k` places that are near by their codes."""
        ids = self._faiss.search(np.asarray(descriptor, np.float32)[None], k)[1][0]
        return ids[ids >= 0]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the centres and how far coding has come."""
        import faiss

        centres = faiss.vector_to_array(self._faiss.pq.centroids)
        return {"centres": centres, "progress": np.array([self.born, self.filled])}


def _best(ids: np.ndarray, cosines: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    if cosines.size > k:
        enough = cosines >= np.partition(cosines, -k)[-k]
        ids, cosines = ids[enough], cosines[enough]
    order = np.lexsort((ids, -cosines))[:k]
    return ids[order], cosines[order]
