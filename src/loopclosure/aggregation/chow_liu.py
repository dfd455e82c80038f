"""Which words appear together: the Chow-Liu tree."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from loopclosure.errors import FitError, ModelError


class ChowLiuTree:
    """The best approximation of a joint distribution of words by a tree, where each word depends on one other.

    The tree is the maximum spanning tree of the mutual information between words. It is grown by Prim's algorithm,
    which needs one row of the mutual information at a time: a vocabulary of W words costs O(W^2) time but O(W) memory.

    Deviations from the sources: the mutual information comes from plain counts, the smoothing is for the probabilities
    alone; words without information about each other are not joined by force, so that the tree may be a forest.

    Parameters
    ----------
    information_bound : float
        Mutual information in nats below which two words count as independent; a word without any better
        neighbour becomes a root, its own parent.
    smoothing : float
        Probabilities are ``smoothing * count / n + (1 - smoothing) / 2``, never 0 and never 1.

    Attributes
    ----------
    parent_ : ndarray of int64, shape (W,)
        The word on which each word depends; a root is its own parent.
    marginal_, given_parent_, given_no_parent_ : ndarray of float64, shape (W,)
        P(z = 1), P(z = 1 | parent seen), P(z = 1 | parent not seen); of a root the three are equal.

    References
    ----------
    Chow & Liu, "Approximating discrete probability distributions with dependence trees", IEEE Trans. Information
    Theory 14(3), 1968; Cummins & Newman, "FAB-MAP", IJRR 27(6), 2008, Sec. 4.2.

    Examples
    --------
    >>> seen = np.array([[1, 1, 0], [1, 1, 1], [0, 0, 1], [0, 0, 0]], bool)
    >>> ChowLiuTree().fit(seen).parent_
    array([0, 0, 2])
    """

    def __init__(self, *, information_bound: float = 0.0005, smoothing: float = 0.98) -> None:
        self.information_bound = information_bound
        self.smoothing = smoothing

    def fit(self, seen: np.ndarray) -> ChowLiuTree:
        """Learn tree and probabilities.

        Parameters
        ----------
        seen : ndarray of bool, shape (n, W)
            Whether image i shows word q. The images should show different places.

        Raises
        ------
        FitError
            If there is no image or no word.
        """
        if seen.ndim != 2 or 0 in seen.shape:
            raise FitError(f"found occurrences of shape {seen.shape}, wanted at least one image and one word")
        seen = seen.astype(bool, copy=False)
        self.parent_ = _maximum_spanning_tree(seen, self.information_bound)
        count, n = seen.sum(0), len(seen)
        both = (seen & seen[:, self.parent_]).sum(0)
        parent_count = count[self.parent_]
        self.marginal_ = self._smooth(count, np.full_like(count, n))
        root = self.parent_ == np.arange(len(count))
        self.given_parent_ = np.where(root, self.marginal_, self._smooth(both, parent_count))
        self.given_no_parent_ = np.where(root, self.marginal_, self._smooth(count - both, n - parent_count))
        return self

    def _smooth(self, count: np.ndarray, n: np.ndarray) -> np.ndarray:
        return self.smoothing * count / np.maximum(n, 1) + (1 - self.smoothing) / 2

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned, for `loopclosure.store`."""
        return {
            "parent": self.parent_,
            "marginal": self.marginal_,
            "given_parent": self.given_parent_,
            "given_no_parent": self.given_no_parent_,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> ChowLiuTree:
        """Rebuild a fitted tree from `to_arrays`.

        Raises
        ------
        ModelError
            If a parent is no word or a probability is not between 0 and 1.
        """
        tree = cls()
        tree.parent_ = np.asarray(arrays["parent"], np.int64)
        tree.marginal_, tree.given_parent_, tree.given_no_parent_ = (
            np.asarray(arrays[name], np.float64) for name in ("marginal", "given_parent", "given_no_parent")
        )
        n_words = len(tree.parent_)
        if n_words and not (tree.parent_.min() >= 0 and tree.parent_.max() < n_words):
            raise ModelError(f"a parent lies outside the {n_words} words: the saved tree is damaged")
        for values in (tree.marginal_, tree.given_parent_, tree.given_no_parent_):
            if values.shape != (n_words,) or not ((values > 0) & (values < 1)).all():
                raise ModelError("a probability is missing or not between 0 and 1: the saved tree is damaged")
        return tree


def _maximum_spanning_tree(seen: np.ndarray, bound: float) -> np.ndarray:
    n_words = seen.shape[1]
    information = _MutualInformation(seen)
    parent = np.arange(n_words)
    strongest = np.full(n_words, bound, np.float64)  # information with the best word in the tree; -inf once in it
    for _ in range(n_words):
        word = int(strongest.argmax())
        strongest[word] = -np.inf
        row = information.row(word)
        better = row > strongest
        better &= strongest > -np.inf
        strongest[better] = row[better]
        parent[better] = word
    return parent


class _MutualInformation:
    """Rows of the mutual information between words, in nats, from counts: sums of ``x log x``."""

    def __init__(self, seen: np.ndarray) -> None:
        self._seen = seen
        self._count = seen.sum(0)
        x = np.arange(len(seen) + 1)
        self._xlogx = x * np.log(np.maximum(x, 1))
        self._margins = self._xlogx[self._count] + self._xlogx[len(seen) - self._count]

    def row(self, word: int) -> np.ndarray:
        n, count, xlogx = len(self._seen), self._count, self._xlogx
        both = self._seen[self._seen[:, word]].sum(0)
        joint = xlogx[both] + xlogx[count - both] + xlogx[count[word] - both]
        joint += xlogx[n - count - count[word] + both]
        return (joint - self._margins - self._margins[word] + xlogx[n]) / n
