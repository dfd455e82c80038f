"""Visual vocabularies: local descriptors to words, an image to a bag of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from loopclosure.aggregation.kmeans import as_vectors, lloyd, nearest, spread_start
from loopclosure.errors import ConfigError, FitError, ModelError


class BagOfWords(NamedTuple):
    """What one image says in words.

    Attributes
    ----------
    words : ndarray of int64, shape (m,)
        Different words, ascending; none for an image without features.
    weights : ndarray of float32, shape (m,)
        Their weights, positive, of sum 1.
    """

    words: np.ndarray
    weights: np.ndarray


EMPTY_BAG = BagOfWords(np.zeros(0, np.int64), np.zeros(0, np.float32))


def occurrence(bags: Sequence[BagOfWords], n_words: int) -> np.ndarray:
    """Return which image shows which word.

    Parameters
    ----------
    bags : sequence of BagOfWords
    n_words : int
        Size of the vocabulary.

    Returns
    -------
    ndarray of bool, shape (len(bags), n_words)
    """
    seen = np.zeros((len(bags), n_words), bool)
    for row, bag in zip(seen, bags, strict=True):
        row[bag.words] = True
    return seen


def l1_normalised(weights: np.ndarray) -> np.ndarray:
    """Scale weights to sum 1; zeros stay zeros.

    Parameters
    ----------
    weights : ndarray of float, shape (m,)
        Not negative.

    Returns
    -------
    ndarray of float32, shape (m,)
    """
    total = weights.sum()
    return (weights / total if total > 0 else weights).astype(np.float32)


class VocabularyTree:
    """Words by hierarchical k-means; with one level it is plain k-means.

    Each node of the tree splits its descriptors into `branching` clusters, `levels` times; the leaves are the words.
    Packed bits (uint8) are clustered under the Hamming distance with majority votes as centres, floats under the
    Euclidean distance.

    Deviations from the sources: a node with fewer descriptors than `branching` is not split, whereas DBoW2 makes a
    word of each of them; nodes start from k-means++ up to 64 clusters and from random descriptors above.

    Parameters
    ----------
    branching : int
        Clusters of each node, k.
    levels : int
        Depth, L: up to k^L words.
    iterations : int
        Of k-means, at most.
    max_samples : int
        At most so many descriptors are clustered, a random choice where there are more; the rarity of words comes from
        all of them.
    seed : int
        Of that choice and of the start.

    Attributes
    ----------
    centres_ : ndarray (nodes, d) float32 or uint8 of packed bits
        Centre of each node; the first row is the root and has none.
    first_child_, children_ : ndarray of int64, shape (nodes,)
        Children of a node are the `children_` rows from `first_child_` on; a leaf has none.
    word_ : ndarray of int64, shape (nodes,)
        Word of a leaf, -1 for the others.
    idf_ : ndarray of float32, shape (W,)
        ``log(N / N_i)`` of each word that N_i of N images show.

    References
    ----------
    Nister & Stewenius, "Scalable recognition with a vocabulary tree", CVPR 2006; Galvez-Lopez & Tardos, "Bags of binary
    words for fast place recognition in image sequences", IEEE Trans. Robotics 28(5), 2012.

    Examples
    --------
    >>> images = np.random.default_rng(0).integers(0, 256, (5, 100, 32), dtype=np.uint8)
    >>> tree = VocabularyTree(branching=4, levels=2).fit(images)
    >>> len(tree), len(tree.assign(images[0]))
    (16, 100)
    """

    def __init__(
        self, branching: int = 10, levels: int = 4, *, iterations: int = 10, max_samples: int = 250_000, seed: int = 0
    ) -> None:
        if branching < 2 or levels < 1:
            raise ConfigError(f"branching = {branching} and levels = {levels}: wanted at least 2 and 1")
        self.branching = branching
        self.levels = levels
        self.iterations = iterations
        self.max_samples = max_samples
        self.seed = seed

    def fit(self, images: Sequence[np.ndarray]) -> VocabularyTree:
        """Learn words and their rarity.

        Parameters
        ----------
        images : sequence of ndarray (n_i, d), float or uint8
            The local descriptors of each image; packed bits if they are uint8.

        Raises
        ------
        FitError
            If there is no image, or kinds are mixed. Images without any descriptor make a vocabulary of one word.
        """
        if len(images) == 0:
            raise FitError("found no images, a vocabulary wants at least one")
        if len({(descriptors.dtype == np.uint8, descriptors.shape[1]) for descriptors in images}) > 1:
            raise FitError("the images have descriptors of different kinds; make them with one extractor")
        rng = np.random.default_rng(self.seed)
        sample = np.concatenate(images)
        if len(sample) > self.max_samples:
            sample = sample[np.sort(rng.choice(len(sample), self.max_samples, replace=False))]
        self._grow(as_vectors(sample), sample.dtype == np.uint8, rng)
        shown = np.zeros(self.word_.max() + 1, np.int64)
        for image in images:
            shown[np.unique(self.assign(image))] += 1
        n_images = max(sum(len(image) > 0 for image in images), 1)
        self.idf_ = np.log(n_images / np.maximum(shown, 1)).astype(np.float32)
        return self

    def _grow(self, vectors: np.ndarray, binary: bool, rng: np.random.Generator) -> None:
        """Split level after level; nodes are numbered in the order in which they appear."""
        centres = [np.zeros((1, vectors.shape[1]), np.float32)]
        first_child, children = [0], [0]
        level = [(0, np.arange(len(vectors)))]
        for _ in range(self.levels):
            below = []
            for node, rows in level:
                split = self._split(vectors[rows], binary, rng)
                if len(split) < 2:
                    continue
                first_child[node], children[node] = len(children), len(split)
                owner = nearest(vectors[rows], split)
                below += [(len(children) + k, rows[owner == k]) for k in range(len(split))]
                centres.append(split)
                first_child += [0] * len(split)
                children += [0] * len(split)
            level = below
        stacked = np.concatenate(centres)
        self.centres_ = np.packbits(stacked > 0, axis=1) if binary else stacked
        self.first_child_, self.children_ = np.array(first_child, np.int64), np.array(children, np.int64)
        self._prepare()

    def _split(self, vectors: np.ndarray, binary: bool, rng: np.random.Generator) -> np.ndarray:
        """Return the centres of the clusters of one node; none of them is empty."""
        if len(vectors) < self.branching:
            return vectors[:0]
        start = spread_start(vectors, self.branching, rng)
        centres = lloyd(vectors, start, iterations=self.iterations, binary=binary)
        return centres[np.unique(nearest(vectors, centres))]

    def _prepare(self) -> None:
        leaf = self.children_ == 0
        self.word_ = np.where(leaf, np.cumsum(leaf) - 1, -1)
        self._vectors = as_vectors(self.centres_)
        self._half = np.square(self._vectors).sum(1) / 2

    def __len__(self) -> int:
        """Return the number of words W; 0 before `fit`."""
        return len(self.idf_) if hasattr(self, "idf_") else 0

    def assign(self, descriptors: np.ndarray) -> np.ndarray:
        """Return the word of each descriptor, found by descent to the nearest child.

        Parameters
        ----------
        descriptors : ndarray (n, d)
            Of the kind that the words were learned from.

        Returns
        -------
        ndarray of int64, shape (n,)

        Raises
        ------
        FitError
            If nothing was fitted, or for another kind.
        """
        if not hasattr(self, "centres_"):
            raise FitError("the vocabulary has no words yet; call fit first")
        binary, width = self.centres_.dtype == np.uint8, self.centres_.shape[1]
        if (descriptors.dtype == np.uint8) != binary or descriptors.shape[1:] != (width,):
            raise FitError(
                f"found descriptors of shape {descriptors.shape} and {descriptors.dtype}, the words have "
                f"{width} {'bytes' if binary else 'numbers'}; were they made by the same extractor?"
            )
        if not len(descriptors) or not self.children_[0]:
            return np.zeros(len(descriptors), np.int64)
        vectors = as_vectors(descriptors)
        top = slice(self.first_child_[0], self.first_child_[0] + self.children_[0])
        node = self.first_child_[0] + nearest(vectors, self._vectors[top])
        inner = np.flatnonzero(self.children_[node])
        while len(inner):
            node[inner] = self._nearest_child(node[inner], vectors[inner])
            inner = inner[self.children_[node[inner]] > 0]
        return self.word_[node]

    def _nearest_child(self, node: np.ndarray, vectors: np.ndarray) -> np.ndarray:
        child = np.empty_like(node)
        order = np.argsort(node, kind="stable")
        starts = np.flatnonzero(np.diff(node[order], prepend=-1))
        for rows in np.split(order, starts[1:]):
            parent = node[rows[0]]
            below = slice(self.first_child_[parent], self.first_child_[parent] + self.children_[parent])
            closeness = vectors[rows] @ self._vectors[below].T - self._half[below]
            child[rows] = below.start + closeness.argmax(1)
        return child

    def transform(self, descriptors: np.ndarray) -> BagOfWords:
        """Return the bag of words of one image, weighted by tf-idf.

        A word that all training images show has the weight 0, but it stays in the bag.
        """
        words, count = np.unique(self.assign(descriptors), return_counts=True)
        return BagOfWords(words, l1_normalised(count * self.idf_[words]))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return what was learned, for `loopclosure.store`."""
        return {
            "centres": self.centres_,
            "first_child": self.first_child_,
            "children": self.children_,
            "idf": self.idf_,
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> VocabularyTree:
        """Take over what `to_arrays` gave; returns the vocabulary.

        Raises
        ------
        ModelError
            If the arrays make no tree.
        """
        first_child, children = arrays["first_child"], arrays["children"]
        inner = np.flatnonzero(children)
        first, nodes = first_child[inner], len(arrays["centres"])
        # Children behind their parent: no descent can run in a circle.
        if (
            not len(first_child) == len(children) == nodes
            or (first <= inner).any()
            or (children < 0).any()
            or (first + children[inner] > nodes).any()
            or np.count_nonzero(children == 0) != len(arrays["idf"])
        ):
            raise ModelError("the saved vocabulary makes no tree: it is damaged")
        self.centres_, self.idf_ = arrays["centres"], arrays["idf"]
        self.first_child_, self.children_ = first_child, children
        self._prepare()
        return self
