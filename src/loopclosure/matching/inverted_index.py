"""Bags of words compared by an inverted index: a frame costs the words that it shows, not the vocabulary."""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping
from itertools import pairwise

import numpy as np

from loopclosure.aggregation.incremental_words import IncrementalWords
from loopclosure.aggregation.words import BagOfWords, l1_normalised
from loopclosure.errors import ModelError
from loopclosure.store import part


class InvertedIndex:
    """For each word the places that show it; places and words are added as the drive goes.

    Parameters
    ----------
    bags : iterable of BagOfWords
        Places to begin with.

    Examples
    --------
    >>> index = InvertedIndex()
    >>> index.add(BagOfWords(np.array([2, 5]), np.array([0.5, 0.5], np.float32)))
    >>> index.add(BagOfWords(np.array([5]), np.array([1.0], np.float32)))
    >>> counts, places, weights = index.postings(np.array([2, 5, 9]))
    >>> counts, places, weights
    (array([1, 2, 0]), array([0, 0, 1], dtype=int32), array([0.5, 0.5, 1. ], dtype=float32))
    """

    def __init__(self, bags: Iterable[BagOfWords] = ()) -> None:
        self._postings: dict[int, tuple[array[int], array[float]]] = {}
        self._length = 0
        for bag in bags:
            self.add(bag)

    def __len__(self) -> int:
        """Return the number of places."""
        return self._length

    @property
    def nbytes(self) -> int:
        """Bytes that the postings take."""
        return sum(len(places) * _POSTING_BYTES for places, _ in self._postings.values())

    def add(self, bag: BagOfWords) -> None:
        """Append a place that shows the words of `bag`."""
        for word, weight in zip(bag.words.tolist(), bag.weights.tolist(), strict=True):
            posting = self._postings.get(word)
            if posting is None:
                posting = self._postings[word] = (array("i"), array("f"))
            posting[0].append(self._length)
            posting[1].append(weight)
        self._length += 1

    def postings(self, words: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where each of `words` occurs.

        Parameters
        ----------
        words : ndarray of int64, shape (m,)

        Returns
        -------
        counts : ndarray of int64, shape (m,)
            Number of places of each word.
        places, weights : ndarray of int32 and float32, shape (counts.sum(),)
            The places, word after word, and the weight of the word at each.
        """
        found = [self._postings.get(word, _NOWHERE) for word in words.tolist()]
        counts = np.array([len(places) for places, _ in found], np.int64)
        places = b"".join([places for places, _ in found])
        weights = b"".join([weights for _, weights in found])
        return counts, np.frombuffer(places, np.int32), np.frombuffer(weights, np.float32)

    def forget(self, words: np.ndarray) -> None:
        """Remove `words` from all places."""
        for word in words.tolist():
            self._postings.pop(word, None)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return all postings, for `loopclosure.store`."""
        words = np.array(sorted(self._postings), np.int64)
        counts, places, weights = self.postings(words)
        return {
            "words": np.repeat(words, counts),
            "places": places,
            "weights": weights,
            "length": np.array([self._length], np.int64),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> InvertedIndex:
        """Take over the postings that `to_arrays` gave; returns the index.

        Raises
        ------
        ModelError
            If the arrays disagree with each other.
        """
        words, places, weights = arrays["words"], arrays["places"], arrays["weights"]
        length = int(arrays["length"][0])
        outside = len(places) and not 0 <= places.min() <= places.max() < length
        if outside or not len(words) == len(places) == len(weights) or (np.diff(words) < 0).any():
            raise ModelError("the inverted index names places that do not exist: the saved map is damaged")
        bounds = [*np.flatnonzero(np.diff(words, prepend=-1)).tolist(), len(words)]
        self._length = length
        self._postings = {
            int(words[start]): (
                array("i", places[start:end].astype(np.int32).tobytes()),
                array("f", weights[start:end].astype(np.float32).tobytes()),
            )
            for start, end in pairwise(bounds)
        }
        return self


_POSTING_BYTES = array("i").itemsize + array("f").itemsize
_TINY = 1e-12
_NOWHERE: tuple[array[int], array[float]] = (array("i"), array("f"))


class BagOfWordsMap:
    """Places by their bags of words, compared by the L1 score.

    ``s = 1 - 0.5 | v / |v| - w / |w| |`` (L1 norms): for weights that are not negative this is the sum of the smaller
    of the two weights over the words that both images show, 1 for equal bags and 0 for bags without a common word.

    Deviations from the source: a bag without words has the score 0 against everything, itself included; scores are
    not divided by the score against the previous frame; direct index and islands belong to later stages.

    References
    ----------
    Galvez-Lopez & Tardos, "Bags of binary words for fast place recognition in image sequences", IEEE Trans. Robotics
    28(5), 2012, Eq. 2; Nister & Stewenius, "Scalable recognition with a vocabulary tree", CVPR 2006.

    Examples
    --------
    >>> places = BagOfWordsMap()
    >>> places.add(BagOfWords(np.array([2, 5]), np.array([0.5, 0.5], np.float32)))
    >>> places.similarities(BagOfWords(np.array([5, 7]), np.array([0.75, 0.25], np.float32)))
    array([0.5], dtype=float32)
    """

    def __init__(self, index: InvertedIndex | None = None) -> None:
        self.index = InvertedIndex() if index is None else index

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self.index)

    @property
    def nbytes(self) -> int:
        """Bytes that the stored places take."""
        return self.index.nbytes

    def add(self, bag: BagOfWords) -> None:
        """Append a place."""
        self.index.add(bag)

    def similarities(self, bag: BagOfWords) -> np.ndarray:
        """Return the L1 score of `bag` against every place.

        Returns
        -------
        ndarray of float32, shape (n,)
            Between 0 and 1.
        """
        counts, places, weights = self.index.postings(bag.words)
        common = np.minimum(np.repeat(bag.weights, counts), weights)
        return np.bincount(places, common, minlength=len(self)).astype(np.float32)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return all places, for `loopclosure.store`."""
        return self.index.to_arrays()

    def restore(self, arrays: Mapping[str, np.ndarray]) -> BagOfWordsMap:
        """Take over what `to_arrays` gave; returns the map."""
        self.index.restore(arrays)
        return self


class IncrementalMap:
    """Places by words that are made on the way: nothing is trained.

    The score is the share of the query's words, weighted by rarity, that the place shows too:
    ``sum_w idf(w) min(tf_q(w), tf_p(w)) / sum_w idf(w) tf_q(w)`` with tf the share of the features of an image that
    belong to w and ``idf(w) = log((N + 1) / N_w)``, where N_w of the N places so far show w. A copy of a place scores
    1, and a feature without any word counts as the rarest.

    Deviations from the sources: places are scored by the common weight instead of votes (Angeli et al.), Bayes filter,
    islands and geometry belong to later stages.

    Parameters
    ----------
    words : IncrementalWords, optional
        Words to begin with; none by default.

    References
    ----------
    Angeli et al. 2008; Garcia-Fidalgo & Ortiz 2018, see `IncrementalWords`.
    """

    def __init__(self, words: IncrementalWords | None = None) -> None:
        self.words = IncrementalWords() if words is None else words
        self.index = InvertedIndex()
        # A frame is first compared, then added: its words are searched once.
        self._last: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self.index)

    @property
    def nbytes(self) -> int:
        """Bytes that words and places take."""
        return self.words.nbytes + self.index.nbytes

    def add(self, descriptors: np.ndarray) -> None:
        """Append a place by its local descriptors, ndarray (n, d) float or uint8; rows of zeros are no features."""
        words, removed = self.words.learn(*self._find(descriptors))
        self._last = None
        self.index.forget(removed)
        words, count = np.unique(words, return_counts=True)
        self.index.add(BagOfWords(words, l1_normalised(count)))

    def similarities(self, descriptors: np.ndarray) -> np.ndarray:
        """Return the score against every place.

        Parameters
        ----------
        descriptors : ndarray (n, d) float or uint8
            Local descriptors of one image; rows of zeros are no features.

        Returns
        -------
        ndarray of float32, shape (len(self),)
            Between 0 and 1; zeros for an image without features.
        """
        found = self._find(descriptors)[1]
        words, count = np.unique(found[found >= 0], return_counts=True)
        frequency = count / max(len(found), 1)
        rarity = np.log((len(self) + 1) / self.words.frames[words])
        unknown = np.count_nonzero(found < 0) / max(len(found), 1) * np.log(len(self) + 1)
        counts, places, weights = self.index.postings(words)
        common = np.repeat(rarity, counts) * np.minimum(np.repeat(frequency, counts), weights)
        score = np.bincount(places, common, minlength=len(self))
        return (score / max(rarity @ frequency + unknown, _TINY)).astype(np.float32)

    def _find(self, descriptors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows that are features, and the word of each."""
        if self._last is None or self._last[0] is not descriptors:
            features = descriptors[descriptors.any(axis=1)]
            self._last = descriptors, features, self.words.find(features)
        return self._last[1:]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return words and places, for `loopclosure.store`."""
        return {
            **{f"words.{name}": array for name, array in self.words.to_arrays().items()},
            **{f"index.{name}": array for name, array in self.index.to_arrays().items()},
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> IncrementalMap:
        """Take over what `to_arrays` gave; returns the map."""
        self.words.restore(part(arrays, "words"))
        self.index.restore(part(arrays, "index"))
        self._last = None
        return self
